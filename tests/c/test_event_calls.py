"""Calls of a scene's C with events: what they refuse, and how jumps that accumulate end them."""

from __future__ import annotations

from pathlib import Path

import pytest
from support.compilation import STRICT, compiled, run
from support.session import needs, tiers

import eomc
from eomc.model.system import from_scene
from eomc.scene.read import parse

BALL = """eomc = 1
name = "ball"
[coordinates]
y = { start = 1.0 }
[parameters]
e = 0.5
g = 9.81
[energy]
kinetic = "y_dot**2/2"
potential = "g*y"
[[event]]
name = "impact"
when = "y"
direction = "falling"
action = "jump"
y_dot = "-e*y_dot"
[run]
duration = 3.0
batch = true
"""
PROGRAM = """#define _GNU_SOURCE /* feenableexcept */
#include "ball.h"
#include <fenv.h>
#include <math.h>
#include <stdio.h>

static void print(const char *what, int status, int holds)
{
    printf("%s %d %d\\n", what, status, holds);
}

/* A run in calls of `steps` steps without memory; fixed steps go on after one is not OK. */
static void bounce(const char *what, double e, long steps)
{
    ball_params p = ball_defaults;
    const double times[2] = { 0.0, 0.3 };
    double q[1] = { 1.0 }, qd[1] = { 0.0 }, rows[4], end = 0;
    ball_options options = { STEPS, .t_end = 3.0, .every = 1, .rows = 2, .times = times };
    ball_output output = { .q_rows = rows, .qd_rows = rows + 2 };
    int status = 0, last = 0, is_above = 1;

    p.e = e;
    options.steps = steps;
    while (!status && output.t < options.t_end) {
        status = (int)ball_integrate(q, qd, &p, &options, &output);
        is_above &= q[0] > -1e-9;
    }
    end = sqrt(2/p.g)*(1 + e)/(1 - e);
    is_above &= fabs(output.limit/end - 1) < 1e-7 && fabs(output.t/end - 1) < 1e-7;
    last = status;
    for (int n = 0; n < 3 && options.h > 0; n++)
        last = (int)ball_integrate(q, qd, &p, &options, &output);
    print(what, status, last == status && is_above && q[0] > -1e-9 && output.t - end < 1e-6);
}

/* Two calls before time zero, without a jump; the first ends where y touches zero. */
static void rise(void)
{
    ball_params p = ball_defaults;
    double q[1] = { -4.0 }, qd[1] = { 8.0 };
    ball_options options = { .t0 = -3.0, .t_end = -2.0, .h = 0.125, .steps = 1000 };
    ball_output output = { 0 };
    int status;

    p.g = 8.0;
    status = (int)ball_integrate(q, qd, &p, &options, &output);
    options.t_end = -1.5;
    status += (int)ball_integrate(q, qd, &p, &options, &output);
    print("rising", status, output.t > -1.6 && q[0] < -0.9);
}

/* Whether a run by steps of size h makes no step, and has status 6. */
static int is_refused(double h)
{
    double q[1] = { 1.0 }, qd[1] = { 0.0 };
    ball_options options = { .t_end = 1.0, .h = h, .steps = 1000 };
    ball_output output = { 0 };
    const int status = (int)ball_integrate(q, qd, &ball_defaults, &options, &output);

    return status == 6 && output.steps == 0 && q[0] == 1.0 && qd[0] == 0.0;
}

int main(void)
{
    double q[1] = { 1.0 }, qd[1] = { 0.0 }, rows[4], row[3];
    const double early[2] = { 0.5, 2.0 };
    int which[1], status;
    ball_options options = {
        .t0 = 1.0, .t_end = 2.0, .h = 0.01, .steps = 1000, .every = 1, .rows = 2, .times = early
    };
    ball_output output = { .q_rows = rows, .qd_rows = rows + 2 };

    status = (int)ball_integrate(q, qd, &ball_defaults, &options, &output);
    print("early", status, output.steps == 0);
    ball_integrate_batch(1, q, qd, &ball_defaults, &options, &output);
    print("batch", (int)output.status, output.steps == 0);
    options.rows = 0;
    options.times = 0;
    output.which = which;
    output.event_rows = row;
    output.room = BALL_NE_ROOM - 1;
    status = (int)ball_integrate(q, qd, &ball_defaults, &options, &output);
    print("room", status, output.steps == 0);
    print("size", is_refused(-0.01), is_refused(NAN));
    print("none", is_refused(0.0), 1); /* adaptive steps if there are any */
    output.room = 0;
    output.which = 0;
    options.ignores_events = 1;
    options.steps = 50;
    status = (int)ball_integrate(q, qd, &ball_defaults, &options, &output);
    print("time", status, output.t > 1.499 && output.t < 1.501);
#ifdef __GLIBC__
    feenableexcept(FE_DIVBYZERO | FE_INVALID | FE_OVERFLOW); /* no operation may trap */
#endif
    bounce("whole", 0.5, 1000000);
    bounce("steps", 0.5, 1);
    bounce("plastic", 0.0, 1000000);
    bounce("steps", 0.0, 1);
    bounce("nearly", 1e-8, 3);
    rise();
    return 0;
}
"""


@pytest.mark.parametrize("folder", [".", "fast"])
@pytest.mark.parametrize(
    "steps",
    tiers(["fixed", "fixed, both directions", "of both kinds", "adaptive"], "of both kinds"),
)
def test_calls_have_a_status_that_says_what_happened(
    folder: str, steps: str, tmp_path: Path
) -> None:
    """Status 6: the options are invalid; 4: jumps accumulate, also in calls without memory."""
    is_fixed = steps.startswith("fixed")
    text = BALL + ("" if is_fixed else "tolerance = 1e-9\n")
    text = text.replace("falling", "both") if "directions" in steps else text
    files = eomc.sources(from_scene(parse(text, "ball.toml"))).files
    for name, text in files.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text, encoding="utf-8")
    size = ".h = 0, .tol = 1e-9" if steps == "adaptive" else ".h = 0.01"
    (tmp_path / "calls.c").write_text(PROGRAM.replace("STEPS", size), encoding="utf-8")
    sources = ("calls.c", f"{folder}/ball.c", f"-I{folder}", "-lm", "-o", "calls")
    compiled(needs("gcc"), *STRICT, "-O1", *sources, cwd=tmp_path)
    lines = run("./calls", cwd=tmp_path).stdout.splitlines()
    refused = ["early 6 1", "batch 6 1", "room 6 1", "size 1 1"]
    refused.append("none 1 1" if is_fixed else "none 0 1")
    accumulated = ["whole 4 1", "steps 4 1", "plastic 4 1", "steps 4 1", "nearly 4 1"]
    accumulated.append("rising 0 1")
    assert lines == [*refused, "time 0 1", *accumulated]


def test_header_states_direction_and_action_of_an_event() -> None:
    header = eomc.sources(from_scene(parse(BALL, "ball.toml"))).files["ball.h"]
    assert "    BALL_EVENT_IMPACT, /* falling, jump */\n" in header
