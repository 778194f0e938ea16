"""Adaptive steps of many instances side by side in the fast form: of small systems."""

from __future__ import annotations

from eomc.emit import adaptive
from eomc.emit import c_function as c
from eomc.emit.adaptive import METHOD, Form, Stepping
from eomc.emit.coefficients import matrix, numbers, rounded
from eomc.emit.fast import runs, views
from eomc.emit.fast.lanes import INLINE, NOINLINE
from eomc.emit.fast.steppers import Steppers
from eomc.scene.schema import LOOSEST


def view(made: Steppers, form: Form) -> views.AdaptiveLanes:
    """The view of their text."""
    one, wide, functions, s = made.one, made.wide, made.functions, made.accelerations
    real, m, stepping = s.target.real, METHOD, Stepping(made.functions, form)
    end, own = real.function_suffix, bool(runs.constants_call(made)) and one.target.needs_p
    rows = {"q_row": "q_row", "qd_row": "qd_row"}
    z = "(times[kept[k]] - s.from)/s.size"
    return views.AdaptiveLanes(
        **functions.names,
        method=stepping.method,
        extent=one.extent,
        inline=wide.qualifiers[INLINE],
        noinline=wide.qualifiers[NOINLINE],
        stages=m.stages,
        f=real.suffix,
        fabs=f"fabs{end}",
        sqrt=f"sqrt{end}",
        eps=s.target.literal(real.epsilon),
        tiny=s.target.literal(1e-30),
        most=adaptive.MOST,
        anew=adaptive.ANEW,
        roughest=s.target.literal(2 * 0.8**-8),
        loosest=s.target.literal(LOOSEST),
        tightest=s.target.literal(adaptive.tightest(real)),
        c=numbers(m.c, real),
        b=numbers(rounded(m.b, real), real),
        bA=numbers(m.b_a, real),
        powers=matrix(list(zip(*m.powers, strict=True)), real),
        top=c.in_braces(numbers(m.legendre(n), real) for n in range(m.stages - 4, m.stages)),
        inputs=bool(s.target.system.inputs),
        constants=bool(s.constants),
        members=s.constants,
        compute_constants=runs.constants_call(made),
        compute_own=one.compute_constants.function.call(c="&constants", p="p + k*p_instance"),
        own=own,
        accelerate=made.accelerate(
            wide,
            a="f",
            q="at[i]",
            qd="moving[i]",
            t=f"{c.member('x', 't')} + h*c_[i]",
            u="given",
            c=f"&{c.member('x', 'c')}",
        ),
        forces=stepping.forces.call(f="f", q="s.q", qd="s.qd", t="s.t", u="given"),
        batch=functions.public.adaptive_batch(m.name),
        alone=adaptive.alone(functions),
        kept=adaptive.keep(stepping).call(q="s.q", qd="s.qd", **rows),
        look=stepping.within.call(
            q_at="q_row", qd_at="qd_row", x="&s", z=z, u="given", memory="memory + k"
        ),
    )
