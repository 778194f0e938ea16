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
from eomc.mechanism.assembly import assembled
from eomc.model.system import from_scene
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

# Members of the options of a run and their values; {N} is the prefix.
OPTIONS = {
    "t0": "(REAL)number()", "t_end": "(REAL)number()", "h": "byte() % 3 ? (REAL)small_number() : 0",
    "tol": "(REAL)small_number()", "max_step": "byte() % 2 ? (REAL)small_number() : 0",
    "stiff": "byte() % 5 == 0", "steps": "up_to(24)", "every": "up_to(5)", "rows": "up_to(60)",
    "max_evaluations": "byte() % 2 ? up_to(500) : 0", "ignores_events": "byte() % 2",
    "u_step": "byte() % 2 ? {N}_NU : 0", "p_instance": "byte() % 2",
    "u_instance": "byte() % 2 ? {N}_NU*(2*options.steps + 2) : 0",
}  # fmt: skip
RUN = """        const long count = {count};
        long i, k;
        {n}_options options;
        {n}_output *output = space((size_t)(count + 1)*sizeof *output);
        REAL *a_q = given(count*{N}_NQ), *a_qd = given(count*{N}_NQ), *times = NULL, at;
{options}
        if (byte() % 2 && options.rows) {{
            options.times = times = unwritten(options.rows);
            for (i = 0, at = options.t0; i < options.rows; i++)
                times[i] = at += (REAL)ldexp(1.0, -(int)(byte() % 30));
        }}
        for (k = 0; k < count; k++) {{
            output[k].q_rows = unwritten(options.rows*{N}_NQ);
            output[k].qd_rows = unwritten(options.rows*{N}_NQ);
{results}
        }}
        REAL *was_q = copied(a_q, count*{N}_NQ), *was_qd = copied(a_qd, count*{N}_NQ);
        for (i = byte() % 2; i >= 0; i--)
            if ({call})
                break;
        if (finite_all(was_q, count*{N}_NQ) && finite_all(was_qd, count*{N}_NQ) &&
            !(finite_all(a_q, count*{N}_NQ) && finite_all(a_qd, count*{N}_NQ)))
            broken("{f}", "a run left what is not finite", 0, a_q, was_q, count*{N}_NQ);"""


class Driver:
    """Generates the driver of one header."""

    def __init__(self, scene: str, header: str) -> None:
        self.n, self.N = scene, scene.upper()
        self.functions = list(functions(header, scene))
        self.real = "float" if re.search(r"\bfloat q\[", header) else "double"
        bare = re.sub(r"/\*.*?\*/", "", header, flags=re.S)
        pattern = rf"typedef struct \{{([^}}]*)\}} {scene}_(options|output);"
        self.structs = {name: text for text, name in re.findall(pattern, bare)}
        self.methods = len(re.findall(rf"\b{self.N}_METHOD_\w+", bare))

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

    def _run(self, f: Function) -> str:
        """Return the lines of a call of `integrate` or `integrate_batch`, or of two in a row."""
        batch, n, N = f.name.endswith("_batch"), self.n, self.N
        options = ["memset(&options, 0, sizeof options);"]
        for name, value in OPTIONS.items():
            if self.has_member("options", name):
                options.append(f"options.{name} = {value.format(N=N)};")
        if self.has_member("options", "method"):
            options.append(f"options.method = ({n}_method)(byte() % {self.methods});")
        results = []
        if self.has_member("output", "t_rows"):
            results.append("output[k].t_rows = unwritten(options.rows);")
        if self.has_member("output", "memory"):
            results.append("output[k].memory = byte() % 3 ? space(sizeof *output->memory) : NULL;")
        if self.has_member("output", "room"):
            results += [
                "output[k].room = up_to(80);",
                "if (byte() % 2) {",
                "    output[k].which = space((size_t)output[k].room*sizeof *output->which);",
                f"    output[k].event_rows = unwritten(output[k].room*(1 + 2*{N}_NQ));",
                "}",
            ]
        one = "1" if not batch or not self.has_member("options", "p_instance") else ""
        p = f"parameters({one or 'options.p_instance ? count : 1'})"
        values = {"count": "count", "q": "a_q", "qd": "a_qd", "options": "&options"}
        values |= {"output": "output", "p": "a_p", "u": "a_u"}
        names = [a.name for a in f.arguments]
        if "p" in names:
            options.append(f"{n}_params *a_p = {p};")
        if "u" in names:
            size = f"{N}_NU*(2*options.steps + 2)*count"
            options.append(f"REAL *a_u = byte() % 2 ? given({size}) : NULL;")
        call = f"{f.name}({', '.join(values[name] for name in names)})"
        return RUN.format(
            count="up_to(9)" if batch else "1", n=n, N=N, f=f.name, call=call,
            options="\n".join(f"        {line}" for line in options),
            results="\n".join(f"            {line}" for line in results),
        )  # fmt: skip

    def has_member(self, struct: str, name: str) -> bool:
        """Return True if a struct of the scene, "options" or "output", has a member."""
        return bool(re.search(rf"\b{name}\b", self.structs[struct]))

    def _case(self, k: int, f: Function) -> str:
        if f.name.endswith(("_integrate", "_integrate_batch")):
            return f"    case {k}: {{\n{self._run(f)}\n        break;\n    }}"
        if f.name.endswith("_block"):
            return f"    case {k}: {{\n{self._block(f)}\n        break;\n    }}"
        values = [self._value(f, a) for a in f.arguments]
        results = [
            (a, name) for a, (name, _) in zip(f.arguments, values, strict=True) if self._result(a)
        ]
        lines = [text for _, text in values if text]
        call = f"{f.name}({', '.join(name for name, _ in values)})"
        before = [(name, self._size(a)) for a, name in results]
        for name, size in before:
            lines.append(f"REAL *was_{name} = copied({name}, {size});")
        lines += self._call(f, call, before)
        inside = "\n        ".join(lines)
        return f"    case {k}: {{\n        {inside}\n        break;\n    }}"

    def _block(self, f: Function) -> str:
        """Return the lines of a call for several states."""
        N, step = self.N, f.name.endswith("_derivative_block")
        NP = f"(long)(sizeof({self.n}_params)/sizeof(REAL))"
        widths = {"q": f"{N}_NQ", "qd": f"{N}_NQ", "t": "1", "u": f"{N}_NU", "p": NP}
        columns = {
            "A": f"2*{N}_NQ",
            "B": f"{N}_NU",
            "Phi": f"2*{N}_NQ",
            "Gamma": f"{N}_NU",
            "E": NP,
        }
        widths |= {name: f"2*{N}_NQ*{width}" for name, width in columns.items()}
        lines = ["const long count = 1 + up_to(19);"]
        for a in f.arguments:
            width = widths.get(a.name.removesuffix("_instance"))
            if a.name.endswith("_instance"):
                lines.append(f"const long a_{a.name} = byte() % 2 ? {width} : 0;")
            elif width:
                fill = "unwritten" if a.name in columns else "given"
                null = "byte() % 4 == 0 ? NULL : " if a.name == "u" and not step else ""
                lines.append(f"REAL *a_{a.name} = {null}{fill}(count*{width});")
            elif a.name == "h":
                lines.append("const REAL a_h = (REAL)small_number();")
        values = ", ".join("count" if a.name == "count" else f"a_{a.name}" for a in f.arguments)
        check = (
            f'if (done < 0 || done > count) broken("{f.name}", "a wrong count", 0, a_q, a_q, 1);'
        )
        lines += [f"const long done = {f.name}({values});", check]
        return "\n".join(f"        {line}" for line in lines)

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
        return [f"(void){call};"]

    def _result(self, a: Argument) -> bool:
        return bool(a.size) and a.kind == self.real

    def _size(self, a: Argument) -> str:
        return f"(long)({a.size})"

    def _value(self, f: Function, a: Argument) -> tuple[str, str]:
        """Return the expression that is passed, and the line that defines it."""
        R, name, own = self.real, a.name, f"a_{a.name}"
        if a.size:
            filled = a.kind.startswith("const") or name in ("q", "qd")
            if not a.kind.startswith("const") and not re.search(r"_(step|project)$", f.name):
                filled = False
            return own, f"{R} *{own} = {'given' if filled else 'unwritten'}({self._size(a)});"
        if a.kind == R:
            return own, f"const {R} {own} = ({R}){'small_number()' if name == 'h' else 'number()'};"
        if name == "p":
            text = f"{self.n}_params *{own} = byte() % 2 ? "
            return own, f"{text}({self.n}_params *)&{self.n}_defaults : parameters(1);"
        if name == "fixed":
            fill = f"for (i = 0; {own} && i < 2*{self.N}_NQ; i++) {own}[i] = (int)(byte() % 2);"
            text = f"byte() % 2 ? space(2*{self.N}_NQ*sizeof *{own}) : NULL"
            return own, f"int *{own} = {text}; {{ int i; {fill} }}"
        if name == "u":
            return own, f"{R} *{own} = byte() % 2 ? given({self.N}_NU) : NULL;"
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
