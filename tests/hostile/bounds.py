"""Run the quick tier with the oldest versions that pyproject.toml allows, in an environment of its
own.

    python tests/hostile/bounds.py                       all of it
    python tests/hostile/bounds.py tests/verify -n 2     a part, with arguments of pytest
"""

from __future__ import annotations

import re
import subprocess
import sys
import tomllib
import venv
from collections.abc import Sequence
from pathlib import Path

ROOT = Path(__file__).parents[2]
PLACE = ROOT / "build" / "hostile" / "oldest"


def oldest() -> list[str]:
    """Return each requirement of runs, pages and tests at its lower bound."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    optional = project["optional-dependencies"]
    requirements = [*project["dependencies"], *optional["plot"], *optional["test"]]
    return [
        text.replace(">=", "==") for text in requirements if re.fullmatch(r"[\w-]+>=[\d.]+", text)
    ]


def main(arguments: Sequence[str]) -> int:
    """Return the status of pytest."""
    venv.create(PLACE, with_pip=True)
    python = str(PLACE / "bin" / "python")
    pip = [python, "-m", "pip", "install", "--quiet"]
    subprocess.run([*pip, *oldest(), "editables"], check=True)
    own = ["--no-deps", "--no-build-isolation", "--editable", str(ROOT)]
    subprocess.run([*pip, *own], check=True)
    print("\n".join(oldest()))
    tests = [python, "-m", "pytest", "-m", "not slow", *(arguments or ["-n", "2"])]
    return subprocess.run(tests, cwd=ROOT, check=False).returncode


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
