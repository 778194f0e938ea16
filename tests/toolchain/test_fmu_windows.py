"""Windows libraries of FMUs, loaded by a small importer under Wine."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path

import pytest
from support.fmus import BALL, VERSIONS, Host, exported, extracted, needs_fmpy
from support.session import needs

pytestmark = pytest.mark.slow
NAMES = ("y", "x", "y_dot", "x_dot", "energy.total")
# it looks up each function by name, as importers do, and steps to 0.9 s
HOST = r"""
#include <stdio.h>
#include <string.h>
#include <windows.h>
#include "fmi/fmiVERSIONFunctionTypes.h"

#define GET(name) name##TYPE *name = (name##TYPE *)(void (*)(void))GetProcAddress(unit, #name); \
    if (!name) { puts("no " #name); return 1; }
#define GOOD(call) do { if ((call) != 0) { puts("failed: " #call); return 1; } } while (0)

#if VERSION == 2
static void logs(fmi2ComponentEnvironment e, fmi2String i, fmi2Status s, fmi2String c,
    fmi2String m, ...)
{
    (void)e; (void)i; (void)s; (void)c; puts(m);
}
#else
static void logs(fmi3InstanceEnvironment e, fmi3Status s, fmi3String c, fmi3String m)
{
    (void)e; (void)s; (void)c; puts(m);
}
#endif

int main(void)
{
    static const unsigned which[] = { REFERENCES };
    enum { N = sizeof which/sizeof *which };
    double found[N];
    int k;
    HMODULE unit = LoadLibraryA("ball.dll");

    if (!unit) { puts("not loaded"); return 1; }
#if VERSION == 2
    fmi2CallbackFunctions back = { logs, calloc, free, NULL, NULL };
    GET(fmi2Instantiate) GET(fmi2SetupExperiment) GET(fmi2EnterInitializationMode)
    GET(fmi2ExitInitializationMode) GET(fmi2DoStep) GET(fmi2GetReal) GET(fmi2Terminate)
    GET(fmi2FreeInstance)
    void *it = fmi2Instantiate("it", fmi2CoSimulation, "TOKEN", "", &back, 0, 0);

    if (!it) return 1;
    GOOD(fmi2SetupExperiment(it, 0, 0, 0, 0, 0));
    GOOD(fmi2EnterInitializationMode(it));
    GOOD(fmi2ExitInitializationMode(it));
    for (k = 0; k < 9; k++)
        GOOD(fmi2DoStep(it, 0.1*k, 0.1, 1));
    GOOD(fmi2GetReal(it, which, N, found));
    GOOD(fmi2Terminate(it));
    fmi2FreeInstance(it);
#else
    fmi3Boolean event, ends, early;
    double last;
    GET(fmi3InstantiateCoSimulation) GET(fmi3EnterInitializationMode)
    GET(fmi3ExitInitializationMode) GET(fmi3DoStep) GET(fmi3GetFloat64) GET(fmi3Terminate)
    GET(fmi3FreeInstance)
    void *it = fmi3InstantiateCoSimulation(
        "it", "TOKEN", "", 0, 0, 0, 0, NULL, 0, NULL, logs, NULL);

    if (!it) return 1;
    GOOD(fmi3EnterInitializationMode(it, 0, 0, 0, 0, 0));
    GOOD(fmi3ExitInitializationMode(it));
    for (k = 0; k < 9; k++)
        GOOD(fmi3DoStep(it, 0.1*k, 0.1, 1, &event, &ends, &early, &last));
    GOOD(fmi3GetFloat64(it, which, N, found, N));
    GOOD(fmi3Terminate(it));
    fmi3FreeInstance(it);
#endif
    for (k = 0; k < N; k++)
        printf("%.17g\n", found[k]);
    return 0;
}
"""


@pytest.mark.parametrize("version", VERSIONS, ids=["fmi2", "fmi3"])
def test_windows_library_computes_the_same_motion(version: int, tmp_path: Path) -> None:
    """A thrown ball hits the ground; results agree to the rounding of another libm."""
    needs_fmpy()
    from fmpy import extract, read_model_description

    gcc, wine = needs("x86_64-w64-mingw32-gcc"), needs("wine")
    extract(str(exported(BALL, version)), str(tmp_path))
    described = read_model_description(str(tmp_path))
    number = {v.name: v.valueReference for v in described.modelVariables}
    token = described.guid if version == 2 else described.instantiationToken
    text = HOST.replace("VERSIONFunction", f"{version}Function").replace("TOKEN", token)
    text = text.replace("REFERENCES", ", ".join(str(number[name]) for name in NAMES))
    at = tmp_path / "sources"
    (at / "host.c").write_text(text, encoding="utf-8")
    arguments = ("-shared", "ball.c", f"fmi/fmi{version}.c", "-o", "ball.dll")
    for words in (arguments, (f"-DVERSION={version}", "host.c", "-o", "host.exe")):
        subprocess.run([gcc, "-std=c99", "-O2", "-I.", *words], cwd=at, check=True)
    quiet = os.environ | {"WINEDEBUG": "-all"}
    process = subprocess.run(
        [wine, "host.exe"], cwd=at, capture_output=True, text=True, env=quiet, timeout=120
    )
    assert process.returncode == 0, process.stdout + process.stderr
    windows_values = [float(word) for word in process.stdout.split()]
    host = Host(exported(BALL, version), folder=extracted(exported(BALL, version)))
    host.start()
    for _ in range(9):
        host.step(0.1)
    local_values = list(host.get(*NAMES))
    host.free()
    assert windows_values == pytest.approx(local_values, rel=1e-9) and windows_values[0] > 0
