"""Steps of RK4 with predicted angles, for their template.

The sines and cosines at two predicted angles are computed one step before, while the processor
waits for accelerations, and rotated by the small difference.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import Any

from sympy import Expr, S

from eomc.emit.c_names import Target, after, arguments
from eomc.emit.fast.rotations import along
from eomc.program.program import TIME
from eomc.program.trig import Angle


def steps(
    target: Target, rotated: Sequence[Angle], uses: Collection[str], scalar: Mapping[str, Any],
    c: str, p: str,
) -> dict[str, Any] | None:  # fmt: skip
    """What is done for each angle and coordinate, stage by stage; None where no angle is rotated.

    uses: what the accelerations read besides sines and cosines. scalar: how they are called, with c
    and p, which stand for what is constants and for the parameters where they are read.
    """
    if not rotated:
        return None
    P, real, names, n = target.prefix, target.real.name, target.names, len(rotated)
    driven, inputs = target.driven, bool(target.system.inputs)
    # signals of time alone serve all stages of a time, and the end of a step the next one's start
    once = inputs and not target.signal_state
    placed = [name for name in names if name in uses or target.signal_state]
    now, middle, end = "t", "t + h_2", "t + h"

    def of(vector: str, angle: Angle, offset: Expr = S.Zero) -> str:
        text = along(target, angle, f"{vector}.", offset)
        return text if text.replace(".", "").replace("_", "").isalnum() else f"({text})"

    def rates(k: int, place: str, v: str, s: str, time: str, u: str) -> str:
        state = f"&a{k}, &{place if placed else 'x.q'}, &{v}"
        if once:
            given = after(f"&{s}", time if TIME in uses else "", u, c)
            return f"{P}_{scalar['solve']}({state}{given});"
        return f"{P}_{scalar['rates_at']}({state}{scalar['call_at'](f'&{s}', time)});"

    def signal(u: str, time: str) -> str:
        given = arguments(u, time if target.signal_t else "", target.p_call)
        return f"{P}_signal({given});"

    def rotate(time: str, distance: str, s: str) -> list[str]:
        by = [
            distance.format(k=k, a1=of("a1", a), a2=of("a2", a), sum=of("sum", a))
            for k, a in enumerate(rotated)
        ]
        return [
            f"{P}_predicted_rotate({d}, &{time}_terms[{k}], &{s}.{a.sine}, &{s}.{a.cosine}, &far);"
            for k, (a, d) in enumerate(zip(rotated, by, strict=True))
        ]

    def at(*lines: str) -> list[str]:
        return [line.replace("$", name) for name in placed for line in lines]

    def moving(line: str) -> list[str]:
        return [line.replace("$", name) for name in names]

    first = "t0 + (" + real + ")(first + {})*h"
    return {
        "count": n,
        "placed": placed,
        "vectors": ("mid, end, place, " if placed else "")
        + "v, r, a1, a2, a3, a4, inner, sum, to, going",
        "arguments": arguments(
            f"{P}_rk4_state *state", f"{real} t0, long first" if driven else "", f"{real} h",
            "long n", "long steps", "long u_stride" if inputs else "", "long every",
            f"const {P}_constants *constants" if c else "", target.p_arg if p else "",
        ),
        "call": arguments(
            "&x", "t0, first" if driven else "", "h", "n", "steps", "u_stride" if inputs else "",
            "every", c, p,
        ),
        "predict": [
            f"{P}_predict(&predicted[{k}], {along(target, a, 'q->', a.offset)}, "
            f"{along(target, a, 'qd->', S.Zero)}, {along(target, a, 'a->', S.Zero)}, mid, end);"
            for k, a in enumerate(rotated)
        ] + [
            f"{P}_predicted_both(&predicted[{k}], &predicted[{k + 1}]);"
            for k in range(0, n - 1, 2)
        ]
        + [f"{P}_predicted_sincos(&predicted[{n - 1}]);"] * (n % 2),
        "timed": driven and (not once or TIME in uses or target.signal_t),
        "once": once,
        "signals_before": [
            signal("u_end", first.format("n")),
            *([] if target.signal_t else [signal("u_mid", "")]),
        ] if once else [],
        "signals": [
            signal("u_mid", middle), signal("u_end", first.format("n + 1")),
        ] if once and target.signal_t else [],
        "begin": [
            line
            for k, a in enumerate(rotated)
            for line in (
                f"{P}_predicted_unpack(&mid_terms[{k}], &end_terms[{k}], &x.predicted[{k}], &far);",
                f"to_mid[{k}] = ({of('x.q', a, a.offset)} - x.predicted[{k}].x[0])"
                f" + (h_2*{of('x.qd', a)} + {of('x.q_rest', a)});",
                f"to_end[{k}] = ({of('x.q', a, a.offset)} - x.predicted[{k}].x[1])"
                f" + (h*{of('x.qd', a)} + {of('x.q_rest', a)});",
            )
        ],
        "rates_1": rates(1, "x.q", "x.qd", "x.s", now, "u_begin"),
        "stage_2": [
            *at("mid.$ = x.q.$ + h_2*x.qd.$;", "end.$ = x.q.$ + h*x.qd.$;"),
            *moving("v.$ = x.qd.$ + h_2*a1.$;"),
            *rotate("mid", "to_mid[{k}]", "now"),
        ],
        "rates_2": rates(2, "mid", "v", "now", middle, "u_mid"),
        "stage_3": [
            *at("place.$ = mid.$ + hh_4*a1.$;"),
            *moving("v.$ = x.qd.$ + h_2*a2.$;"),
            *rotate("mid", "to_mid[{k}] + hh_4*{a1}", "now"),
        ],
        "rates_3": rates(3, "place", "v", "now", middle, "u_mid"),
        "stage_4": [
            *at("place.$ = end.$ + hh_2*a2.$;"),
            *moving("v.$ = x.qd.$ + h*a3.$;"),
            *rotate("end", "to_end[{k}] + hh_2*{a2}", "now"),
        ],
        "rates_4": rates(4, "place", "v", "now", end, "u_end"),
        "end": rotate("end", "to_end[{k}] + hh_6*{sum}", "x.s"),
        "all": " + ".join(f"(to.{name} + going.{name})" for name in names),
        "rows": [
            line
            for k, name in enumerate(names)
            for line in (f"x.q_rows[{k}] = x.q.{name};", f"x.qd_rows[{k}] = x.qd.{name};")
        ],
    }  # fmt: skip
