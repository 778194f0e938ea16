# make demo    set up, build and check the cart-pole scenes, run one, draw it
# make test    set up, run the quick tests
# make docs    the site of the documentation, build/docs/index.html; warnings are errors
# make bench   against others (an environment of 2.6 GB, a C++ compiler); writes benchmarks/*.md
# make wheel   a wheel and an sdist into dist/
# make fuzz    attacks the readers of text, without end; finds go to build/hostile/finds
# make endurance   builds, runs and checks in a loop, for a quarter of an hour: nothing may grow
# make test-all, make test-slow, make lint, make golden, make clean

PYTHON ?= python3
BIN := .venv/bin
# Python compiles what it imports; to compile all there is takes as long as to install it
INSTALL := $(BIN)/python -m pip install --quiet --no-compile
# a half of the tests each, in their order: neighbours share what they derive and compile;
# SymPy keeps more of what it has worked out than its thousand values
PYTEST := SYMPY_CACHE_SIZE=200000 $(BIN)/python -m pytest -n 2 --dist worksteal
DEMO := scenes/cartpole.toml scenes/cartpole_driven.toml scenes/cartpole_tutorial.toml
# what a test run writes, it writes under build/
export PYTHONPYCACHEPREFIX := $(CURDIR)/build/pycache
# some shells forbid bytecode: every command then takes four seconds to start, instead of 0.7
unexport PYTHONDONTWRITEBYTECODE

.PHONY: demo docs wheel test test-all test-slow fuzz endurance lint golden bench clean

demo: .venv/demo
	@$(BIN)/eomc build $(DEMO)
	@$(BIN)/eomc check --quiet $(DEMO)
	@echo "compared with the pure-Python reference: 3 scenes agree"
	@echo
	@$(BIN)/eomc run scenes/cartpole.toml --plot build/cartpole.png --out build/cartpole.csv
	@echo
	@echo "the picture:         build/cartpole.png"
	@echo "the numbers:         build/cartpole.csv"
	@echo "the C to embed:      build/cartpole/cartpole.h, build/cartpole/cartpole.c"
	@echo "the Python module:   PYTHONPATH=build $(BIN)/python -c 'import cartpole; print(cartpole.simulate())'"
	@echo "the command:         $(BIN)/eomc --help"

# pictures of the gallery are drawn when their scenes change
docs: .venv/docs
	$(BIN)/python -m sphinx -W --keep-going -q -b html -d build/docs-cache docs build/docs
	@echo "the site:   build/docs/index.html"

wheel: .venv/bin/python
	@$(INSTALL) "hatchling>=1.26"
	@$(BIN)/python -m hatchling build -d dist

test: .venv/test
	$(PYTEST) -m "not slow"

test-all: .venv/robots .venv/hostile build/katex/done build/axe/done
	$(PYTEST)

test-slow: .venv/robots .venv/hostile build/katex/done build/axe/done
	$(PYTEST) -m slow

# ten minutes of each reader in turn, for ever
fuzz: .venv/hostile
	@while true; do for t in formula read scene urdf mjcf command; do \
	$(BIN)/python tests/hostile/readers.py $$t --seconds 600 --seed 0 2>&1 | grep -v "^INFO\|^WARNING"; \
	done; done

endurance: .venv/test
	$(BIN)/python tests/hostile/endurance.py --minutes 15

lint: .venv/dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy -p eomc --cache-dir build/mypy

# the C of csrc/solver and its tests
format-c: .venv/dev
	$(BIN)/python tests/c/c_format.py

golden: .venv/test
	$(BIN)/python tests/c/test_golden.py --accept
	$(BIN)/python tests/support/bad_scenes.py
	PYTHONPATH=tests $(BIN)/python tests/report/test_drawing.py
	PYTHONPATH=tests $(BIN)/python tests/report/test_picture_images.py

bench: build/bench/done
	build/bench/bin/python benchmarks/loop.py
	build/bench/bin/python benchmarks/peers.py
	build/bench/bin/python benchmarks/bodies.py
	build/bench/bin/python benchmarks/digits.py
	build/bench/bin/python benchmarks/adaptive.py
	build/bench/bin/python benchmarks/adaptive_batches.py
	build/bench/bin/python benchmarks/constrained.py
	build/bench/bin/python benchmarks/iftomm.py
	build/bench/bin/python benchmarks/sweep.py

# what the LaTeX of equations is compiled with, where npm is there; else that test is skipped
build/katex/done:
	@mkdir -p build/katex
	@if command -v npm >/dev/null; then npm install --silent --prefix build/katex katex@0.16.11; fi
	@touch $@

build/axe/done:
	@mkdir -p build/axe
	@if command -v npm >/dev/null; then npm install --silent --prefix build/axe axe-core@4.14.1; fi
	@touch $@

build/bench/done: pyproject.toml benchmarks/requirements.txt
	$(PYTHON) -m venv build/bench
	build/bench/bin/python -m pip install --quiet --editable . -r benchmarks/requirements.txt
	@touch $@

# what fuzzes; there are wheels for Linux and some Pythons alone
.venv/hostile: .venv/dev
	-$(INSTALL) --only-binary :all: --editable ".[hostile]"
	@touch $@

clean:
	rm -rf build dist

.venv/bin/python:
	$(PYTHON) -m venv .venv
	$(INSTALL) --upgrade pip

.venv/demo: pyproject.toml .venv/bin/python
	$(INSTALL) --editable ".[plot]"
	@touch $@

.venv/test: pyproject.toml .venv/bin/python
	$(INSTALL) --editable ".[test]"
	@touch $@ .venv/demo

.venv/dev: pyproject.toml .venv/bin/python
	$(INSTALL) --editable ".[dev]"
	@touch $@ .venv/test .venv/demo

.venv/docs: pyproject.toml .venv/bin/python
	$(INSTALL) --editable ".[docs]"
	@touch $@

# half a gigabyte of robots, the simulator that they are held against, compilers for other machines,
# importers of units of FMI, Dask for sweeps, JAX for exports
.venv/robots: .venv/dev
	$(INSTALL) --editable ".[robots,cross,fmu,cluster,jax]"
	@touch $@
