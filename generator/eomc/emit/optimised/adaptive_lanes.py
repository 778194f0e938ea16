"""Adaptive steps of many instances in parallel, in optimised C for small systems."""

from __future__ import annotations

from eomc.emit import adaptive
from eomc.emit import c_function as c
from eomc.emit.adaptive import METHOD, Stepping, SweepInterface
from eomc.emit.optimised import runs, views
from eomc.emit.optimised.lanes import INLINE, NOINLINE
from eomc.emit.optimised.steppers import Steppers
from eomc.scene.schema import MAX_TOLERANCE


def view(steppers: Steppers, form: SweepInterface) -> views.AdaptiveLanes:
    """Return the template data for adaptive steps of many instances side by side.

    steppers: the scene's integration methods in optimised C. form: the C calls and arguments that
    optimised C supplies to the code of adaptive steps, which both forms of C share.
    """
    one, wide, s, m = steppers.one, steppers.wide, steppers.accelerations, METHOD
    stepping, computed = Stepping(steppers.functions, form), runs.constants_call(steppers)
    here = {"q": "at[i]", "qd": "moving[i]", "t": f"{c.member('x', 't')} + h*c_[i]"}
    return views.AdaptiveLanes(
        **adaptive.tableau(stepping),
        inline=wide.qualifiers[INLINE],
        noinline=wide.qualifiers[NOINLINE],
        max_roughness=s.target.literal(adaptive.REJECT_AFTER_TWO),
        loosest=s.target.literal(MAX_TOLERANCE),
        tightest=s.target.literal(adaptive.tightest(s.target.real)),
        inputs=bool(s.target.system.inputs),
        constants=bool(s.constants),
        members=s.constants,
        compute_constants=computed,
        compute_own=one.compute_constants.function.call(c="&constants", p="p + k*p_instance"),
        own=bool(computed) and one.target.needs_p,
        accelerate=steppers.accelerate(wide, a="f", **here, u="input", c=f"&{c.member('x', 'c')}"),
        forces=stepping.forces.call(f="f", q="s.q", qd="s.qd", t="s.t", u="input"),
        batch=steppers.functions.public.adaptive_batch(m.name),
        alone=adaptive.call_for_instance(steppers.functions),
        store_row=adaptive.row_storage(stepping).call(q="s.q", qd="s.qd"),
        look=stepping.interpolate.call(
            q_at="q_row", qd_at="qd_row", x="&s", u="input", memory="memory + k",
            z="(times[row_counts[k]] - s.from - s.from_rest)/s.size",
        ),
    )  # fmt: skip
