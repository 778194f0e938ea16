"""Random bytes as arguments of every function of a scene's header, with ASan and UBSan.

    python tests/hostile/entry_points.py --seconds 60           each scene, plain and fast
    python tests/hostile/entry_points.py four_bar --form fast --seed 3

The driver is generated from the header: arrays have the documented lengths, numbers are ordinary in
half of the inputs; in the other half some are infinite, NaN, huge or tiny. With clang, libFuzzer
guides it to new branches; with gcc the bytes are random. Besides errors reported by sanitizers, a
function that returns OK must leave finite results, and one that does not must leave its arguments
unchanged.
"""

from __future__ import annotations

import argparse
import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import eomc
from eomc.model.from_scene import from_scene
from eomc.program.assembly import assembled
from eomc.scene.read import parse

HERE = Path(__file__).parent
ROOT = HERE.parents[1]
LOCAL = HERE / "corpus" / "scene"
SANITIZERS = "address,undefined,float-cast-overflow"
INPUTS = 400_000  # at least a second's worth without libFuzzer

# scenes of this name or of the corpus, and lines added under [run]
VARIANTS: dict[str, tuple[str, str]] = {
    "cartpole_driven": ("cartpole_driven", 'method = ["rk4", "dp8"]\nbatch = true\n'),
    "double_pendulum": (
        "double_pendulum", 'method = ["rk4", "gauss4", "gauss8", "euler"]\nlinearize = true\n'
        "discretize = true\ntolerance = 1e-9\ninverse_dynamics = true\n",
    ),
    "four_bar": (
        "four_bar", "batch = true\ntolerance = 1e-9\nlinearize = true\ndiscretize = true\n",
    ),
    "cartpole": ("cartpole", "batch = true\ntolerance = 1e-9\n"),
    "bouncer": ("bouncer", ""),
    "bouncers": ("bouncer", "batch = true\nmethod = \"rk4\"\n"),
    "arm": ("arm", ""),
    "single": ("double_pendulum", 'real = "float"\nmethod = ["rk4", "gauss8"]\ntolerance = 1e-4\n'),
}  # fmt: skip


@dataclass(frozen=True)
class Argument:
    """An argument of a prototype: the text before its name, and its array length."""

    kind: str
    name: str
    size: str


@dataclass(frozen=True)
class Function:
    """A prototype of the header."""

    result: str
    name: str
    arguments: tuple[Argument, ...]


def functions(header: str, scene: str) -> Iterator[Function]:
    """Yield all prototypes of a header."""
    bare = re.sub(r"/\*.*?\*/", "", header, flags=re.S)
    for match in re.finditer(rf"^(\w+) ({scene}_\w+)\(([^;]*?)\);", bare, re.M | re.S):
        arguments = tuple(_argument(text) for text in match[3].split(","))
        yield Function(match[1], match[2], arguments)


def _argument(text: str) -> Argument:
    match = re.fullmatch(r"\s*(.*?)\s*(\w+)\s*(?:\[(.*)\])?\s*", " ".join(text.split()))
    assert match is not None, text
    return Argument(match[1], match[2], match[3] or "")


# --- driver ---------------------------------------------------------------------------------------

# Names of scalar arguments and their values; {R} is the element type, {N} and {n} the prefixes.
SCALARS = {
    "steps": "up_to(24)", "every": "up_to(5)", "count": "up_to(9)", "room": "up_to(80)",
    "first": "byte() % 3 ? up_to(9) : 1099511627776L", "u_stride": "byte() % 2 ? {nu} : 0",
    "u_instance": "byte() % 2 ? {nu}*(steps + 1) : 0", "u_step": "byte() % 2 ? {nu} : 0",
    "p_instance": "(long)(byte() % 2)",
}  # fmt: skip
ARRAYS = {
    "q_rows": "{rows}*{N}_NQ", "qd_rows": "{rows}*{N}_NQ", "t_rows": "{rows}",
    "event_rows": "room*(1 + 2*{N}_NQ)",
}  # fmt: skip


class Driver:
    """Generates the driver of one header."""

    def __init__(self, scene: str, header: str) -> None:
        self.n, self.N = scene, scene.upper()
        self.functions = list(functions(header, scene))
        self.fixed = bool(re.search(r"_fixed_step\s*\*step;", header))
        self.real = "float" if re.search(r"\bfloat q\[", header) else "double"
        self.nu = f"{self.N}_NU" if f"{self.N}_NU" in header else "0"

    def text(self) -> str:
        """Return the whole text."""
        cases = "\n".join(self._case(k, f) for k, f in enumerate(self.functions))
        return (
            f"#define REAL {self.real}\n#include <{self.n}.h>\n#include <entry_points.h>\n\n"
            f"static {self.n}_params *parameters(long count)\n{{\n"
            f"    {self.n}_params *made = space((size_t)count*sizeof *made);\n    long k;\n\n"
            "    for (k = 0; k < count; k++) {\n"
            f"        made[k] = {self.n}_defaults;\n"
            "        if (byte() % 2)\n"
            f"            ((REAL *)made)[up_to((long)(sizeof *made/sizeof(REAL)) - 1) + k*"
            "(long)(sizeof *made/sizeof(REAL))] = (REAL)number();\n"
            "    }\n    return made;\n}\n\n"
            f"static void one(void)\n{{\n    switch (byte() % {len(self.functions)}) {{\n"
            f"{cases}\n    }}\n}}\n"
        )

    def _case(self, k: int, f: Function) -> str:
        names = [a.name for a in f.arguments]
        batch, adaptive = f.name.endswith("_batch"), f.name.endswith("_adaptive")
        rows = "2*steps" if adaptive else "count*row_count" if batch else "(steps + 1)"
        lines = []
        for name in SCALARS:  # in this order, because some depend on others
            if name in names:
                value = SCALARS[name].format(nu=self.nu)
                lines.append(f"const long {name} = {value};")
        many = f.name.endswith("_adaptive_batch")
        if many:
            lines.append("const long row_count = up_to(6);")
        elif batch:
            lines[:] = [x.replace(SCALARS["first"], "up_to(9)") for x in lines]
            lines.append("const long row_count = (first + steps)/(every ? every : 1) + 2;")
        if "times" in names:
            lines.append("const int asked = byte() % 2;")
            rows = rows if many else "(asked ? count : 2*steps)"
        values = [self._value(f, a, rows, batch) for a in f.arguments]
        results = [
            (a, name) for a, (name, _) in zip(f.arguments, values, strict=True) if self._result(a)
        ]
        lines += [text for _, text in values if text]
        row_count = "row_count" if many else "count"
        if many:
            lines.append(
                "{ long i; for (i = 0; i < count; i++) a_memory[i].stiff = byte() % 5 == 0; }"
            )
        if "times" in names:
            lines.append(
                f"{{ REAL at = *a_t; long i; for (i = 0; a_times && i < {row_count}; i++) "
                "a_times[i] = at += (REAL)ldexp(1.0, -(int)(byte() % 30)); }"
            )
        call = f"{f.name}({', '.join(name for name, _ in values)})"
        before = [(name, self._size(a)) for a, name in results]
        for name, size in before:
            lines.append(f"REAL *was_{name} = copied({name}, {size});")
        lines += self._call(f, call, before)
        inside = "\n        ".join(lines)
        return f"    case {k}: {{\n        {inside}\n        break;\n    }}"

    def _call(self, f: Function, call: str, before: Sequence[tuple[str, str]]) -> list[str]:
        if f.result.endswith("_status"):
            lines = [f"const int status = (int){call};"]
            if f.name.endswith("_step") or f.name.endswith("_project"):
                # inputs need not be finite
                fine = " && ".join(f"finite_all(was_{n}, {s})" for n, s in before) or "1"
                lines.append(f"const int fine = {fine};")
            else:
                lines.append("const int fine = 1;")
            return lines + [
                f'if (fine || status) promised("{f.name}", status, {n}, was_{n}, {s});'
                for n, s in before
            ]
        if f.result == "long":
            # with a workspace, and possibly in two parts
            again = f"if (byte() % 2 && *a_status == {self.N}_OK) (void){call};"
            fresh = "if (byte() % 3 == 0) a_memory = space(sizeof *a_memory);"
            lines = [
                fresh,
                *self._stepped(f),
                f"(void){call};",
                f"if (a_memory != NULL) {{ {again} }}",
            ]
            fine = " && ".join(f"finite_all(was_{n}, {s})" for n, s in before)
            if any(a.name == "t" and a.kind == f"{self.real} *" for a in f.arguments):
                fine += " && isfinite(before_t)"
            lines.append(
                f"if ({fine}) {{ {' '.join(self._check_finite(f, n, s) for n, s in before)} }}"
            )
            return lines
        again = [f"if (byte() % 2) (void){call};"] if f.name.endswith("_adaptive_batch") else []
        return [f"(void){call};", *again]

    def _stepped(self, f: Function) -> list[str]:
        """Return steps of fixed size with event location, as a substitute for adaptive ones."""
        steps = [x.name for x in self.functions if x.name.endswith("_step")]
        if not (f.name.endswith("_adaptive") and self.fixed):
            return []
        return [f"if (a_memory && byte() % 2) a_memory->step = {one};" for one in steps]

    def _check_finite(self, f: Function, name: str, size: str) -> str:
        what = f'"{f.name}", "a run left what is not finite"'
        arguments = f"(int)*a_status, {name}, was_{name}, {size}"
        return f"if (!finite_all({name}, {size})) broken({what}, {arguments});"

    def _result(self, a: Argument) -> bool:
        return bool(a.size) and a.kind == self.real

    def _size(self, a: Argument) -> str:
        return f"(long)({a.size})"

    def _value(self, f: Function, a: Argument, rows: str, batch: bool) -> tuple[str, str]:
        """Return the expression that is passed, and the line that defines it."""
        R, name, own = self.real, a.name, f"a_{a.name}"
        if a.kind == "long":
            return name, ""
        if a.size:
            return self._reals(f, a, rows, batch)
        if a.kind == R:
            small = name in ("h", "tol", "max_step")
            return own, f"const {R} {own} = ({R}){'small_number()' if small else 'number()'};"
        if name == "p":
            count = "(p_instance ? count : 1)" if batch else "1"
            text = f"{self.n}_params *{own} = "
            default = "" if batch else f"byte() % 2 ? ({self.n}_params *)&{self.n}_defaults : "
            return own, f"{text}{default}parameters({count});"
        if name == "memory" and batch:
            text = f"space((size_t)(count + 1)*sizeof *{own})"
            return own, f"{f.name.removesuffix('_batch')}_memory *{own} = {text};"
        if name == "memory":
            return own, f"{f.name.removesuffix('_run')}_memory *{own} = NULL;"
        if name == "status":
            kind = "int" if batch else f"{self.n}_status"
            count = "(size_t)count*" if batch else ""
            return own, f"{kind} *{own} = space({count}sizeof *{own});"
        if name in ("completed", "events", "row_counts"):
            count = "1" if name == "events" and not batch else "count + 1"
            return own, f"long *{own} = space((size_t)({count})*sizeof *{own});"
        if name == "fixed":
            fill = f"for (i = 0; {own} && i < 2*{self.N}_NQ; i++) {own}[i] = (int)(byte() % 2);"
            text = f"byte() % 2 ? space(2*{self.N}_NQ*sizeof *{own}) : NULL"
            return own, f"int *{own} = {text}; {{ int i; {fill} }}"
        if name == "which":
            text = f"space((size_t)({'count*' if batch else ''}room)*sizeof *{own})"
            return own, f"int *{own} = byte() % 2 ? {text} : NULL;"
        return self._reals(f, a, rows, batch)

    def _reals(self, f: Function, a: Argument, rows: str, batch: bool) -> tuple[str, str]:
        """Return an array of numbers."""
        R, name, own = self.real, a.name, f"a_{a.name}"
        if a.size:
            filled = a.kind.startswith("const") or name in ("q", "qd")
            if not a.kind.startswith("const") and not re.search(
                r"_(step|run|adaptive|project)$", f.name
            ):
                filled = False
            return own, f"{R} *{own} = {'given' if filled else 'unwritten'}({self._size(a)});"
        if name == "u":
            count = self.nu
            if batch:
                count = f"{self.nu}*(steps + 1)*(u_instance ? count : 1)"
            elif any(x.name == "u_stride" for x in f.arguments):
                count = f"{self.nu}*(steps + 1)"
            return own, f"{R} *{own} = byte() % 2 ? given({count}) : NULL;"
        if name in ("q", "qd"):  # of a batch
            return own, f"{R} *{own} = given(count*{self.N}_NQ);"
        if name == "t":
            count = "count + 1" if batch else "1"
            text = f"{R} *{own} = given({count})"
            return own, f"{text}; const {R} before_t = *{own}; (void)before_t;"
        if name == "times":
            return own, f"{R} *{own} = asked ? given({'row_count' if batch else 'count'}) : NULL;"
        if name in ARRAYS:
            size = ARRAYS[name].format(rows=rows, N=self.N)
            size = f"count*{size}" if batch and name == "event_rows" else size
            return own, f"{R} *{own} = unwritten({size});"
        raise AssertionError(f"{f.name}: what is {a}?")


# --- building and running -------------------------------------------------------------------------


def scene_text(name: str) -> str:
    """Return the text of a scene or of one of VARIANTS."""
    base, more = VARIANTS.get(name, (name, ""))
    file = next(
        f / f"{base}.toml" for f in (LOCAL, ROOT / "scenes") if (f / f"{base}.toml").exists()
    )
    text = file.read_text(encoding="utf-8")
    for line in more.splitlines():
        text = re.sub(rf"(?m)^{line.split(' =')[0]}\s*=.*\n", "", text)
    return (
        text.replace("[run]\n", "[run]\n" + more) if "[run]\n" in text else text + "[run]\n" + more
    )


def compilers() -> Iterator[tuple[list[str], bool]]:
    """Yield commands, and whether they have libFuzzer."""
    for name in ("clang", "clang-14", "clang-15", "clang-16", "clang-19"):
        if path := shutil.which(name):
            with tempfile.TemporaryDirectory() as place:
                file = Path(place) / "x.c"
                file.write_text(
                    "int LLVMFuzzerTestOneInput(void);int LLVMFuzzerTestOneInput(void){return 0;}"
                )
                words = [path, f"-fsanitize=fuzzer,{SANITIZERS}", "x.c", "-o", "x"]
                if subprocess.run(words, cwd=place, capture_output=True).returncode == 0:
                    yield [path], True
    if path := shutil.which("gcc"):
        yield [path], False


def built(name: str, form: str, folder: Path) -> tuple[Path, bool]:
    """Compile the driver of a scene; return its path and whether it contains libFuzzer."""
    system = assembled(from_scene(parse(scene_text(name), f"{name}.toml")))
    for file, text in eomc.sources(system, "_none").files.items():
        if file.endswith((".c", ".h")):
            (folder / file).parent.mkdir(parents=True, exist_ok=True)
            (folder / file).write_text(text, encoding="utf-8")
    at = folder if form == "plain" else folder / "fast"
    header = (at / f"{system.name}.h").read_text(encoding="utf-8")
    (folder / "driver.c").write_text(Driver(system.name, header).text(), encoding="utf-8")
    command, fuzzer = next(compilers())
    words = [
        f"-fsanitize={SANITIZERS}",
        "-fno-sanitize-recover=all",
        "-g",
        "-O1",
        "-fno-math-errno",
    ]
    words += ["-std=c99" if form == "plain" else "-std=gnu99", f"-I{at}", f"-I{HERE}"]
    if form == "fast":
        words.append("-march=native")
    words += ["-fsanitize=fuzzer"] if fuzzer else ["-DALONE"]
    files = ["driver.c", f"{at}/{system.name}.c", "-lm", "-o", "driver"]
    process = subprocess.run([*command, *words, *files], cwd=folder, capture_output=True, text=True)
    if process.returncode:
        raise RuntimeError(process.stderr)
    return folder / "driver", fuzzer


def run_driver(name: str, form: str, seconds: int, seed: int, folder: Path) -> tuple[bool, str]:
    """Run a driver; return whether there are no findings, and its output."""
    driver, fuzzer = built(name, form, folder)
    grown = ROOT / "build" / "hostile" / "corpus" / f"c_{name}_{form}"
    grown.mkdir(parents=True, exist_ok=True)
    if fuzzer:
        words = [str(grown), f"-max_total_time={seconds}", f"-seed={seed}", "-max_len=512"]
        words += ["-len_control=0", "-timeout=10", "-rss_limit_mb=1024", "-print_final_stats=1"]
    else:
        words = [str(INPUTS * seconds // 10), str(seed)]
    with_own = {
        **os.environ,
        "ASAN_OPTIONS": "detect_leaks=0",
        "UBSAN_OPTIONS": "print_stacktrace=1",
    }
    # Run by a shell, because the peak memory that Linux reports is at least that of the parent.
    process = subprocess.run(
        ["sh", "-c", '"$@" & wait $!', "sh", str(driver), *words],
        cwd=folder,
        capture_output=True,
        text=True,
        env=with_own,
        errors="replace",
    )
    return process.returncode == 0, process.stderr


def main(arguments: Sequence[str]) -> int:
    """Return 1 if there are findings."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("scenes", nargs="*", help=" ".join(VARIANTS))
    parser.add_argument("--form", choices=["plain", "fast"])
    parser.add_argument("--seconds", type=int, default=20, help="each")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--keep", type=Path, help="where the drivers are left")
    options = parser.parse_args(arguments)
    findings, calls = 0, 0
    for name in options.scenes or VARIANTS:
        for form in [options.form] if options.form else ["plain", "fast"]:
            with tempfile.TemporaryDirectory() as place:
                folder = Path(place)
                if options.keep:
                    folder = options.keep / f"{name}_{form}"
                    folder.mkdir(parents=True, exist_ok=True)
                good, words = run_driver(name, form, options.seconds, options.seed, folder)
            count = re.search(r"^CALLS (\d+).*$", words, re.M)
            calls += int(count[1]) if count else 0
            print(f"{name}, {form}: {count[0].lower() if count else 'ended early'}", flush=True)
            if not good:
                findings += 1
                print(words[-6000:], flush=True)
    print(f"in all {calls} calls, {findings} finds")
    return int(bool(findings))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
