"""Runge-Kutta methods: coefficients as fractions, exact or to 40 digits, and their properties.

For q'' = a(q, qd, t), with A c equal to the row sums, only accelerations are needed:

    Q_i = q + c_i h qd + h^2 sum_k (A A)_ik a_k        r = q  + h qd + h^2 sum_k (b A)_k a_k
    V_i = qd + h sum_k A_ik a_k                        v = qd + h sum_k b_k a_k

(Hairer, Norsett & Wanner, *Solving Ordinary Differential Equations I*, sec. II.14). With other
matrices in place of A A and b A it is a Nystrom method; the methods of Euler and Verlet are written
in this form.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from decimal import Decimal, localcontext
from fractions import Fraction
from functools import cached_property
from math import comb, inf, isfinite, lcm
from typing import Any

Row = tuple[Fraction, ...]


@dataclass(frozen=True)
class Method:
    """The coefficients and properties of a Runge-Kutta or Nystrom method with fixed steps.

    Attributes
    ----------
    name, title, order, source
        Identifier, description, order of convergence and reference.
    limits
        Limits of the step size h, as a pair: the largest h omega for an undamped oscillation (omega
        in rad/s), and the largest h lambda for a decaying motion exp(-lambda t). Beyond them, steps
        are unstable, or the equations of the stages can't be solved by iteration.
    a, b
        Matrix A and weights b of the Butcher tableau. In an explicit method, rows of A end before
        the diagonal.
    notes
        Further properties, as lines of a comment in the generated C.
    nodes, end
        Nodes c (times of the stages, as fractions of a step) and row vector b A of a Nystrom
        method; empty if they follow from `a` and `b`.
    sweeps
        Fixed number of iterations for the stages of an implicit method; 0 if Newton's method is
        used or the method is explicit.
    """

    name: str
    title: str
    order: int
    source: str
    limits: tuple[float, float]
    a: tuple[Row, ...]
    b: Row
    notes: tuple[str, ...] = ()
    nodes: Row = ()
    end: Row = ()
    sweeps: int = 0

    @property
    def description(self) -> str:
        """The title with the order."""
        return self.title if "order" in self.title else f"{self.title}, order {self.order}"

    @property
    def stability(self) -> str:
        """The limits of the step size h as text, "" if there are none.

        They are given for undamped oscillation with angular frequency omega, and for pure decay
        with rate lambda.
        """
        undamped, decay = self.limits
        text = f"h omega <= {undamped:.3g} undamped"
        pure_decay = f", h lambda <= {decay:.3g} for pure decay." if isfinite(decay) else "."
        return text + pure_decay if isfinite(undamped) else ""

    @property
    def about(self) -> tuple[str, ...]:
        """Lines of a comment: description, reference, further properties and limits of h."""
        return (
            f"{self.description[0].upper()}{self.description[1:]}",
            f"({self.source}).",
            *(() if self.sweeps else self.notes),
            *((f"Stability limits: {self.stability}",) if self.stability else ()),
        )

    @property
    def stages(self) -> int:
        """Number of stages: points within a step at which the accelerations are evaluated."""
        return len(self.b)

    @cached_property
    def implicit(self) -> bool:
        """Whether the method is implicit: A has nonzero entries on or above the diagonal."""
        return any(any(row[i:]) for i, row in enumerate(self.a))

    @property
    def newton(self) -> bool:
        """Whether Newton's method solves the equations of the stages.

        It also converges for stiff systems. It is used if the method is implicit and has no fixed
        number of iterations.
        """
        return self.implicit and not self.sweeps

    @cached_property
    def c(self) -> Row:
        """The nodes c, which are the times of the stages as fractions of the step.

        They are the row sums of A unless `nodes` is given.
        """
        return self.nodes or tuple(sum(row, Fraction(0)) for row in self.a)

    @cached_property
    def a_squared(self) -> tuple[Row, ...]:
        """The matrix product A A.

        With the accelerations k at the stages and the step size h, h^2 A A k is the contribution of
        the accelerations to the positions at the stages.
        """
        return tuple(_times(row, self.a) for row in self.a)

    @cached_property
    def b_a(self) -> Row:
        """The row vector b A, or `end` if that is given.

        With the accelerations k at the stages and the step size h, h^2 b A k is the contribution of
        the accelerations to the position at the end of the step.
        """
        return self.end or _times(self.b, self.a)

    @cached_property
    def extrapolation(self) -> tuple[Row, ...]:
        """Matrix E that extrapolates the stage accelerations of one step to the stages of the next.

        The polynomial through the accelerations at the nodes of one step is evaluated at the nodes
        of the next step. Both steps have the same size.
        """
        return tuple(tuple(_value(basis, 1 + x) for basis in _lagrange(self.c)) for x in self.c)

    @cached_property
    def powers(self) -> tuple[Row, ...]:
        """Matrix from values at the nodes c to the coefficients of the polynomial through them.

        The coefficients are those of the powers of 2 c - 1, lowest power first.
        """
        return tuple(zip(*_lagrange(tuple(2 * x - 1 for x in self.c)), strict=True))

    def legendre(self, n: int) -> Row:
        """Return weights, one for each stage, that give the coefficient of P_n(2 c - 1).

        Here P_n is the Legendre polynomial of degree n. The polynomial through given values at the
        nodes c is expanded in Legendre polynomials; the coefficient of P_n is the sum of the
        weights times the values. Valid for Gauss methods and n < stages.
        """
        p = _legendre(n)
        return tuple((2 * n + 1) * b * _value(p, x) for b, x in zip(self.b, self.c, strict=True))

    @cached_property
    def eigen(self) -> tuple[tuple[Row, ...], tuple[Row, ...], tuple[Row, ...]]:
        """Eigendecomposition of A as a tuple (eigenvalues, forward, back).

        eigenvalues: the eigenvalues with positive imaginary part, as pairs (real, imaginary).
        forward: two rows for each eigenvalue. Their products with the values at the stages are the
        real and the imaginary part of the component along its eigenvector. back: two rows for each
        eigenvalue. The values at the stages are the sum of these rows times the real and imaginary
        parts. Valid if A has an even number of stages and no real eigenvalues.
        """
        from mpmath import matrix, mp, mpf

        with mp.workdps(_DIGITS + 10):
            a = matrix([[mpf(x.numerator) / x.denominator for x in row] for row in self.a])
            values, right = mp.eig(a)
            left = right**-1
            pairs = sorted(
                (k for k, mu in enumerate(values) if mu.imag > 0), key=lambda k: values[k].imag
            )

            def fractions(numbers: Iterable[Any]) -> Row:
                return tuple(Fraction(mp.nstr(x, _DIGITS)) for x in numbers)

            there, back = [], []
            for k in pairs:
                v = [right[i, k] / right[0, k] for i in range(self.stages)]
                w = [left[k, i] * right[0, k] for i in range(self.stages)]
                there += [fractions(x.real for x in w), fractions(x.imag for x in w)]
                back += [fractions(2 * x.real for x in v), fractions(-2 * x.imag for x in v)]
            mu = [fractions((values[k].real, values[k].imag)) for k in pairs]
        return tuple(mu), tuple(there), tuple(back)

    @cached_property
    def a_extrapolated(self) -> tuple[Row, ...]:
        """The matrix product A E, with the matrix E of `extrapolation`.

        It multiplies the stage accelerations of the previous step. The result is A times the
        accelerations that are extrapolated to the stages of the current step.
        """
        return tuple(_times(row, self.extrapolation) for row in self.a)

    @cached_property
    def a_squared_extrapolated(self) -> tuple[Row, ...]:
        """The matrix product A A E, with the matrix E of `extrapolation`.

        It multiplies the stage accelerations of the previous step. The result is A A times the
        accelerations that are extrapolated to the stages of the current step.
        """
        return tuple(_times(row, self.extrapolation) for row in self.a_squared)


def _times(row: Row, a: tuple[Row, ...]) -> Row:
    """Return the product of a row and the matrix `a`."""
    n = len(a)
    padded = [[*r, *([Fraction(0)] * (n - len(r)))] for r in a]
    return tuple(sum((x * padded[j][k] for j, x in enumerate(row)), Fraction(0)) for k in range(n))


def _sparse(text: str) -> tuple[Row, ...]:
    """Return a triangular matrix from lines `row column value column value ...`; other entries are
    zero.
    """
    lines = [line.split() for line in text.strip().splitlines()]
    entries = {
        (int(i), int(k)): Fraction(x)
        for i, *row in lines
        for k, x in zip(row[::2], row[1::2], strict=True)
    }
    last = max(i for i, _ in entries)
    return tuple(tuple(entries.get((i, k), Fraction(0)) for k in range(i)) for i in range(last + 1))


RK4 = Method(
    name="rk4",
    title="the classical Runge-Kutta method",
    order=4,
    source="Hairer, Norsett & Wanner, Solving ODEs I, table II.1.2",
    limits=(2.82, 2.78),
    a=_sparse("1 0 1/2\n2 1 1/2\n3 2 1"),
    b=(Fraction(1, 6), Fraction(1, 3), Fraction(1, 3), Fraction(1, 6)),
)

# row 12 contains the weights
_DP8 = _sparse(
    """
     1  0 5.26001519587677318785587544488e-2
     2  0 1.97250569845378994544595329183e-2  1 5.91751709536136983633785987549e-2
     3  0 2.95875854768068491816892993775e-2  2 8.87627564304205475450678981324e-2
     4  0 2.41365134159266685502369798665e-1  2 -8.84549479328286085344864962717e-1
     4  3 9.24834003261792003115737966543e-1
     5  0 3.7037037037037037037037037037e-2  3 1.70828608729473871279604482173e-1
     5  4 1.25467687566822425016691814123e-1
     6  0 3.7109375e-2  3 1.70252211019544039314978060272e-1  4 6.02165389804559606850219397283e-2
     6  5 -1.7578125e-2
     7  0 3.70920001185047927108779319836e-2  3 1.70383925712239993810214054705e-1
     7  4 1.07262030446373284651809199168e-1  5 -1.53194377486244017527936158236e-2
     7  6 8.27378916381402288758473766002e-3
     8  0 6.24110958716075717114429577812e-1  3 -3.36089262944694129406857109825
     8  4 -8.68219346841726006818189891453e-1  5 2.75920996994467083049415600797e1
     8  6 2.01540675504778934086186788979e1  7 -4.34898841810699588477366255144e1
     9  0 4.77662536438264365890433908527e-1  3 -2.48811461997166764192642586468
     9  4 -5.90290826836842996371446475743e-1  5 2.12300514481811942347288949897e1
     9  6 1.52792336328824235832596922938e1  7 -3.32882109689848629194453265587e1
     9  8 -2.03312017085086261358222928593e-2
    10  0 -9.3714243008598732571704021658e-1  3 5.18637242884406370830023853209
    10  4 1.09143734899672957818500254654  5 -8.14978701074692612513997267357
    10  6 -1.85200656599969598641566180701e1  7 2.27394870993505042818970056734e1
    10  8 2.49360555267965238987089396762  9 -3.0467644718982195003823669022
    11  0 2.27331014751653820792359768449  3 -1.05344954667372501984066689879e1
    11  4 -2.00087205822486249909675718444  5 -1.79589318631187989172765950534e1
    11  6 2.79488845294199600508499808837e1  7 -2.85899827713502369474065508674
    11  8 -8.87285693353062954433549289258  9 1.23605671757943030647266201528e1
    11  10 6.43392746015763530355970484046e-1
    12  0 5.42937341165687622380535766363e-2  5 4.45031289275240888144113950566
    12  6 1.89151789931450038304281599044  7 -5.8012039600105847814672114227
    12  8 3.1116436695781989440891606237e-1  9 -1.52160949662516078556178806805e-1
    12  10 2.01365400804030348374776537501e-1  11 4.47106157277725905176885569043e-2
    """
)
DP8 = Method(
    name="dp8",
    title="the method of Dormand and Prince of order 8",
    order=8,
    source="Hairer, Norsett & Wanner, Solving ODEs I, sec. II.10, the 8th-order weights of DOP853",
    limits=(5.96, 6.39),
    a=_DP8[:12],
    b=_DP8[12],
)

# --- Gauss and Legendre ---------------------------------------------------------------------------

_DIGITS = 45  # decimals of the nodes; the last few may be wrong
_NONE = Decimal(0)


def _value(polynomial: Row, x: Fraction) -> Fraction:
    """Evaluate a polynomial, lowest power first. Fractions are reduced only once, at the end."""
    denominator = lcm(*(c.denominator for c in polynomial))
    value, power = 0, 1  # over whole and powers of x's denominator
    for c in reversed(polynomial):
        value = value * x.numerator + c.numerator * (denominator // c.denominator) * power
        power *= x.denominator
    return Fraction(value * x.denominator, denominator * power)


def _integral(polynomial: Row) -> Row:
    """Return the integral of a polynomial from 0."""
    return (Fraction(0), *(c / (k + 1) for k, c in enumerate(polynomial)))


def _lagrange(nodes: Row) -> tuple[Row, ...]:
    """Return the Lagrange polynomials of the nodes, which are 1 at one node and 0 at the others."""
    denominator, polynomials = lcm(*(x.denominator for x in nodes)), []
    numerators = [x.numerator * (denominator // x.denominator) for x in nodes]
    for i, numerator in enumerate(numerators):
        basis, size = [1], 1  # in whole x
        for node in (x for k, x in enumerate(numerators) if k != i):
            basis = [a - node * b for a, b in zip([0, *basis], [*basis, 0], strict=True)]
            size *= numerator - node
        polynomials.append(tuple(Fraction(c * denominator**k, size) for k, c in enumerate(basis)))
    return tuple(polynomials)


def _legendre(s: int) -> Row:
    """Return the coefficients of Legendre's polynomial P_s(2 x - 1)."""
    return tuple(Fraction((-1) ** (s + k) * comb(s, k) * comb(s + k, k)) for k in range(s + 1))


def _legendre_roots(s: int) -> Row:
    """Return the zeros of Legendre's polynomial P_s(2 x - 1), by Newton's method in decimals."""
    p = [Decimal(x.numerator) for x in _legendre(s)]
    roots: list[Decimal] = []
    with localcontext() as context:
        context.prec = _DIGITS + 10
        for _ in range(s):
            x = Decimal("-0.01")  # from the left, Newton's method converges to the next root
            for _ in range(100):
                value = sum((c * x**k for k, c in enumerate(p)), _NONE)
                slope = sum((k * c * x ** (k - 1) for k, c in enumerate(p) if k), _NONE)
                step = value / (slope - value * sum((1 / (x - root) for root in roots), _NONE))
                x -= step
                if abs(step) < Decimal(10) ** -(_DIGITS + 5):
                    break
            roots.append(x)
        return tuple(Fraction(round(x, _DIGITS)) for x in roots)


def gauss(s: int, name: str) -> Method:
    """Return the Gauss method: a_ij is the integral of the j-th Lagrange polynomial from 0 to
    c_i.
    """
    c = _legendre_roots(s)
    integrals_ = [_integral(basis) for basis in _lagrange(c)]
    return Method(
        name=name,
        title=f"the implicit method of Gauss and Legendre with {s} stages",
        order=2 * s,
        source="Hairer & Wanner, Solving ODEs II, sec. IV.5; zeros of Legendre's polynomial "
        f"to {_DIGITS} digits",
        limits=(inf, inf),
        a=tuple(tuple(_value(area, x) for area in integrals_) for x in c),
        b=tuple(_value(area, Fraction(1)) for area in integrals_),
        notes=(
            "A-stable: no step is too long for a motion that decays. Symmetric, and symplectic in",
            "(q, p) where D is constant; where D depends on q, in (q, qd) nearly so.",
        ),
    )


GAUSS4, GAUSS6, GAUSS8 = (gauss(s, f"gauss{2 * s}") for s in (2, 3, 4))


def _gauss_with_iteration(s: int, sweeps: int, name: str, limits: tuple[float, float]) -> Method:
    """Return a Gauss method whose stages are extrapolated from the last step and iterated a few
    times.

    P. J. van der Houwen & B. P. Sommeijer, J. Comput. Appl. Math. 29 (1990), 111-127, iterate in
    this way to compute the stages in parallel. The extrapolation has an error of order h^s, and
    each iteration gains a factor of h, or h^2 where accelerations do not depend on velocities.
    sweeps: odd, since two sets of accelerations alternate.
    """
    order = min(2 * s, s + sweeps)
    return replace(
        gauss(s, name),
        title=f"the method of Gauss and Legendre with {s} stages, found in {sweeps} sweeps",
        order=order,
        limits=limits,
        notes=(
            "The accelerations at the stages begin as the polynomial through those of the step",
            f"before, and {sweeps} sweeps put those found there in their place, all stages side by",
            "side (van der Houwen & Sommeijer, J. Comput. Appl. Math. 29 (1990), 111-127, iterate",
            f"so). Of order {2 * s}, and {order} where they depend on velocities. No",
            "derivatives: h must be small against the fastest motion, also where that died out.",
        ),
        sweeps=sweeps,
    )


# The limits are those for which the iteration of the stages converges; a test computes them.
GAUSS16 = _gauss_with_iteration(8, 5, "gauss16", (9.0, 7.2))

# --- Euler and Verlet -----------------------------------------------------------------------------

_ONE, _HALF, _ZERO = Fraction(1), Fraction(1, 2), Fraction(0)

EULER = Method(
    name="euler",
    title="the semi-implicit method of Euler",
    order=1,
    source="Hairer, Lubich & Wanner, Geometric Numerical Integration, sec. I.1.2",
    limits=(2.0, 2.0),
    a=((_ZERO,),),
    b=(_ONE,),
    notes=(
        "v = qd + h a(q, qd), r = q + h v. Symplectic where D is constant and forces depend on",
        "positions alone; of order 1 everywhere.",
    ),
    end=(_ONE,),
)
VERLET = Method(
    name="verlet",
    title="the method of Stoermer and Verlet, position form",
    order=2,
    source="Hairer, Lubich & Wanner, Geometric Numerical Integration, sec. I.1.4",
    limits=(2.0, inf),
    a=((_ZERO,),),
    b=(_ONE,),
    notes=(
        "v = qd + h a(q + h/2 qd), r = q + h/2 (qd + v). For accelerations that depend on",
        "positions and time alone; symmetric, and symplectic where the forces have a potential.",
    ),
    nodes=(_HALF,),
    end=(_HALF,),
)

METHODS: Mapping[str, Method] = {
    m.name: m for m in (RK4, DP8, GAUSS4, GAUSS6, GAUSS8, GAUSS16, EULER, VERLET)
}
