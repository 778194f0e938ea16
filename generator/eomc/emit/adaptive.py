"""Steps of a size that a tolerance asks for, in both forms of C: one text over a form's sweep."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from eomc.emit import c_function as c
from eomc.emit.c_function import CArgument, CFunction
from eomc.emit.coefficients import matrix, numbers, rounded
from eomc.emit.functions import Functions
from eomc.emit.plain.views import Adaptive
from eomc.integrators.tableaux import GAUSS16

METHOD = GAUSS16
TITLE = f"the implicit method of Gauss and Legendre with {METHOD.stages} stages"
MOST = 14  # sweeps of a step


def memory(functions: Functions) -> str:
    """The type of what a run hands on from call to call."""
    return f"{functions.prefix}_{METHOD.name}_adaptive_memory"


def kept(coordinates: int, width: int) -> int:
    """Numbers that it has room for; width: of a vector of coordinates."""
    return 6 * width + METHOD.stages * coordinates + 16


@dataclass(frozen=True)
class Form:
    """What a form of C brings: a sweep's arguments q, qd, t, h and so on, and calls.

    sweep: of a sweep from *a to b. start: of the accelerations f at q, qd. extent: of vectors of
    coordinates. constants: whether what parameters decide is a struct c; compute_constants: its
    call, which fails where there are none.
    """

    around: tuple[CArgument, ...]
    sweep: str
    start: str
    extent: str
    constants: bool = False
    compute_constants: str = ""

    @property
    def rest(self) -> Sequence[CArgument]:
        """Those arguments that are the same all along a run."""
        return [a for a in self.around if a.name in "ucp"]


def view(functions: Functions, form: Form) -> Adaptive:
    """Adaptive steps over the sweeps of a form."""
    target, m, real = functions.target, METHOD, functions.target.real
    method, name = f"{functions.prefix}_{m.name}", functions.real
    end = real.function_suffix
    state = f"{method}_adaptive_state"
    run = functions.public.adaptive(m.name)
    tol, held = CArgument(name, "tol"), c.filled(memory(functions), "memory")
    settle = CFunction(
        f"{method}_settled", "int",
        (c.filled(f"{method}_stages", "a"), *form.around, tol, CArgument(name, "most"),
         c.filled(name, "rough"), c.filled("int", "sweeps")),
        qualifier="static",
    )  # fmt: skip
    step = CFunction(
        f"{method}_adapted", functions.status,
        (c.filled(state, "x"), CArgument(name, "t_end"), tol, *form.rest, held),
        qualifier="static",
    )  # fmt: skip
    within = CFunction(
        f"{method}_inside", "void",
        (c.filled(name, "q_at"), c.filled(name, "qd_at"), c.given(state, "x"),
         CArgument(name, "z"), tol, *form.rest, held),
        qualifier="static",
    )  # fmt: skip
    known = {"a": "&a", "rough": "&rough", "sweeps": "&sweeps"}
    row = f"{functions.NQ}*rows"
    return Adaptive(
        **functions.names,
        title=TITLE,
        method=method,
        extent=form.extent,
        stages=m.stages,
        f=real.suffix,
        fabs=f"fabs{end}",
        sqrt=f"sqrt{end}",
        eps=target.literal(real.epsilon),
        tiny=target.literal(1e-30),
        most=MOST,
        c=numbers(m.c, real),
        b=numbers(rounded(m.b, real), real),
        bA=numbers(m.b_a, real),
        powers=matrix(m.powers, real),
        last=numbers(m.legendre(m.stages - 1), real),
        before=numbers(m.legendre(m.stages - 2), real),
        timed=target.driven,
        constants=form.constants,
        unread_p=target.needs_p and not form.compute_constants and not _takes_p(form),
        compute_constants=form.compute_constants,
        settle=settle,
        sweep=form.sweep,
        step=step,
        start=form.start,
        settled=settle.call(most=f"{target.literal(2 * 0.8**-8)}*aim", **known),
        within=within,
        settled_within=settle.call(most=target.literal(1e30), **known),
        run=run,
        advance=step.call(x="&x"),
        look=within.call(q_at=f"q_rows + {row}", qd_at=f"qd_rows + {row}", x="&x"),
    )


def _takes_p(form: Form) -> bool:
    return any(a.name == "p" for a in form.around)
