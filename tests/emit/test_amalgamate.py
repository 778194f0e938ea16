"""The amalgamation copies from the library what a model needs, and nothing else."""

from __future__ import annotations

from dataclasses import replace

import pytest

from eomc.base import resources
from eomc.emit.common.amalgamate import (
    Names,
    defined_name,
    paragraphs,
    reachable,
    select,
    without_unused_arguments,
)
from eomc.emit.common.c_expression import DOUBLE, FLOAT, Block, Real
from eomc.emit.common.c_function import CArgument, CFunction, input_array

TEXT = """/* A file. */

#if EOM_EVENTS
enum { EOM_LIMIT = 3 };

#endif
/* A table. */
static const real eom_table[2] = { 1, 2 };

static real eom_helper(const real *x)
{
    return eom_table[0]*x[0];
}

static inline real *eom_other(real *x)
{
    return x;
}

static int eom_root(real *x, const eom_model *m)
{
#if !EOM_EVENTS
    (void)m; /* eom_other is not used */
#endif
    return eom_helper(x) > (real)0.5 && eom_call(x, m);
}
"""


def names(real: Real, has_model: bool = True) -> Names:
    """Return the names of a model `ball`."""
    prefixes = {"eom_": "ball_", "eom_root": "ball_gauss16_root"}
    model = input_array("eom_model", "m") if has_model else None
    return Names({"EOM_EPS": "1e-16"}, prefixes, real, model)


@pytest.mark.parametrize(("events", "present"), [(True, "EOM_LIMIT"), (False, "(void)m")])
def test_features_select_lines(events: bool, present: str) -> None:
    text = select(TEXT, {"EVENTS": events})
    assert present in text
    assert ("EOM_LIMIT" in text) != ("(void)m" in text)
    assert "#" not in text


@pytest.mark.parametrize(
    "line", ["#ifdef EOM_X", "#if EOM_X && EOM_Y", "  #define X", "#elif EOM_X"]
)
def test_other_directives_are_refused(line: str) -> None:
    with pytest.raises(ValueError, match="line 1: only #if EOM_X"):
        select(line + "\n#endif", {"X": True})


def test_unknown_features_and_open_conditions_are_refused() -> None:
    with pytest.raises(KeyError):
        select("#if EOM_UNKNOWN\n#endif", {})
    with pytest.raises(ValueError, match="no #endif"):
        select("#if EOM_X", {"X": True})


def test_only_definitions_that_the_roots_use_are_reachable() -> None:
    parts = paragraphs(select(TEXT, {"EVENTS": True}))
    assert [defined_name(part) for part in parts] == [
        "", "", "eom_table", "eom_helper", "eom_other", "eom_root",
    ]  # fmt: skip
    assert reachable(parts, ["x = eom_root(q)"]) == {"eom_table", "eom_helper", "eom_root"}


def test_names_and_numbers_become_those_of_the_model() -> None:
    text = "eom_root(x, m) + eom_f(q, m) + (real)0.5 + (real)1e-3*EOM_EPS, const eom_model *m)"
    assert names(DOUBLE).apply(text) == (
        "ball_gauss16_root(x, m) + ball_f(q, m) + 0.5 + 1e-3*1e-16, const ball_model *m)"
    )
    assert names(FLOAT, has_model=False).apply(text) == (
        "ball_gauss16_root(x) + ball_f(q) + 0.5f + 1e-3f*1e-16)"
    )


def test_calls_of_a_function_that_only_calls_another_become_calls_of_that_one() -> None:
    arguments = (input_array("double", "q"), CArgument("double", "t"), input_array("void", "m"))
    body = (Block("", ("return ball_acceleration(q, m->p);",)),)
    forward = CFunction("ball_accelerate", "int", arguments, body)
    assert forward.is_forward
    renamed = replace(names(DOUBLE), forwards=(forward,))
    text = "x = eom_accelerate(&q[f(1, 2)], t + h, m) + eom_accelerate_all(q, t, m);"
    assert renamed.apply(text) == (
        "x = ball_acceleration(&q[f(1, 2)], m->p) + ball_accelerate_all(q, t, m);"
    )


def test_arguments_that_functions_do_not_use_are_left_out() -> None:
    functions = (
        "/* x at t. */\nstatic int inner(const real *x, real t, int n)\n{\n    (void)n;\n\n"
        "    return x[0] > 0;\n}",
        "static int outer(real *x, real t, int n)\n{\n    return inner(x, t, f(n, 1));\n}",
        "static int root(real *x, real t)\n{\n    return outer(x, t, 2);\n}",
    )
    assert without_unused_arguments(functions, ["root"]) == (
        "/* x at t. */\nstatic int inner(const real *x)\n{\n    return x[0] > 0;\n}",
        "static int outer(real *x)\n{\n    return inner(x);\n}",
        "static int root(real *x, real t)\n{\n    (void)t;\n\n    return outer(x);\n}",
    )


def test_each_file_of_the_library_begins_with_a_comment_on_the_file() -> None:
    for file in sorted((resources.folder("csrc") / "solver").glob("*.[ch]")):
        first = paragraphs(file.read_text(encoding="utf-8"))[0]
        assert first.startswith("/*"), file.name
        assert first.endswith("*/"), file.name
