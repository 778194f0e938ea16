"""Lowering from a tape to the intermediate representation: simplify, count and name values."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace

import sympy
from sympy import Expr, S, Symbol

from eomc.derive.tape import Stage, Tape, split
from eomc.program.common_subexpressions import ScheduleBuilder, reduce_operations
from eomc.program.ir import Assignment, Call, Cost, Function, Operand, Product, Sum, Value, rename


def lower(
    name: str,
    tape: Tape,
    outputs: Sequence[Expr],
    reserved: frozenset[str] = frozenset(),
    *,
    checks: Sequence[tuple[Expr, Expr]] = (),
    labels: Sequence[str] = (),
) -> Function:
    """Return a function of the generated code, as the list of assignments that compute its results.

    Parameters
    ----------
    name
        Name of the function.
    tape
        The elementary operations from which the assignments are made.
    outputs
        The results: numbers, names on the tape, or numbers times names.
    reserved
        Names that no value may have. Names that the function does not read are included, since
        values of several functions may be members of the same struct as parameters.
    checks
        Pairs (pivot, diagonal entry), in the form of `outputs`. The function fails unless all
        pivots are positive.
    labels
        Preferred names for the outputs, then for pivots and diagonal entries. They are used for
        values that have no name in the scene.
    """
    ends = [*outputs, *(atom for pair in checks for atom in pair)]
    work = _TapeReader(tape)
    for symbol in tape.live(ends):
        work.take(symbol)
    operands = [work.operand(atom) for atom in ends]
    reduce_operations(work, operands)
    assignments = work.assignments(operands)
    for o, label in zip(operands, labels, strict=False):
        if o.coefficient == 1 and o.name in work.values:
            work.hints.setdefault(o.name, label)
    early = tuple(a for a in assignments if a.stage <= Stage.PARAMETER)
    body = tuple(a for a in assignments if a.stage > Stage.PARAMETER)
    pairs = operands[len(outputs) :]
    function = Function(
        name,
        early,
        body,
        tuple(operands[: len(outputs)]),
        tuple(zip(pairs[::2], pairs[1::2], strict=True)),
        _cost(body, operands[: len(outputs)]),
        "",
        (),
    )
    return _renamed(function, work.hints, reserved)


class _TapeReader(ScheduleBuilder):
    """The assignments of a function, as they are read from a tape (list of named operations)."""

    def __init__(self, tape: Tape) -> None:
        super().__init__()
        self.tape = tape

    def take(self, symbol: Symbol) -> None:
        """Add the definition of a name on the tape to the assignments."""
        tape = self.tape
        if symbol in tape.weights:
            terms = tuple((w, self.leaf(name)) for name, w in tape.weights[symbol].items())
            self.put(symbol.name, Sum(terms, tape.constant[symbol]))
        elif symbol in tape.powers:
            # factors without exponent first, then powers, as SymPy sorts them
            powers = sorted(
                tape.powers[symbol].items(), key=lambda p: (p[1] is not S.One, p[0].name)
            )
            factors = [f for name, e in powers for f in self._power(self.operand(name), e)]
            self.put(symbol.name, self._plain(Product(S.One, tuple(factors))))
        elif (rhs := tape.rhs(symbol)).is_Mul or rhs.is_Pow:
            self.put(symbol.name, self._product(rhs))
        else:
            function = rhs.func.__name__.lower()
            args = rhs.args[:1] if function == "heaviside" else rhs.args
            if function in ("min", "max"):
                args = sorted(args, key=str)
            self.put(symbol.name, Call(function, tuple(map(self.operand, args))))
        if symbol in self.tape.hint:
            self.hints[symbol.name] = self.tape.hint[symbol]

    def operand(self, atom: Expr) -> Operand:
        """Return an atom of the tape (number times name) as an operand."""
        factor, symbol = split(atom)
        if symbol is None:
            return Operand(factor)
        return Operand(factor, self.leaf(symbol))

    def leaf(self, symbol: Symbol) -> str:
        """Return the name of a symbol; if it has no definition, also record its binding time."""
        if symbol in self.tape.leaves:
            self.stages[symbol.name] = self.tape.leaves[symbol]
        return str(symbol.name)

    def _product(self, rhs: Expr) -> Value:
        """Return the value of a product of powers."""
        coefficient: Expr = S.One
        factors: list[str] = []
        for factor in sympy.Mul.make_args(rhs):
            base, exponent = factor.as_base_exp()
            if factor.is_number:
                coefficient *= factor
            elif not (base.is_Symbol and exponent.is_number):
                args = (self.operand(base), self.operand(exponent))
                factors.append(self.new(Call("pow", args)))
            else:
                factors += self._power(self.operand(base), exponent)
        return self._plain(Product(coefficient, tuple(factors)))

    def _plain(self, product: Product) -> Value:
        """Return the product, or the definition of its only factor."""
        if len(product.factors) == 1 and product.coefficient == 1:
            return self.values.get(product.factors[0], product)
        return product

    def _power(self, base: Operand, exponent: Expr) -> list[str]:
        """Return factors of a power: repeated for integers, a square root for halves, else a call
        of pow.
        """
        doubled = 2 * exponent
        if not doubled.is_Integer or abs(doubled) > 16:
            return [self.new(Call("pow", (base, Operand(exponent))))]
        whole, half = divmod(abs(int(doubled)), 2)
        if exponent > 0:
            root = [self.new(Call("sqrt", (base,)))] if half else []
            return [base.name] * whole + root
        if not half:
            return [self.new(Call("reciprocal", (base,)))] * whole
        root_ = self.new(Call("sqrt", (base,)))
        return [self.new(Call("reciprocal", (Operand(S.One, root_),)))] * (2 * whole + 1)


def _cost(body: Sequence[Assignment], outputs: Sequence[Operand]) -> Cost:
    """Count the operations of assignments and outputs."""
    adds = muls = divs = calls = 0
    angles = set()
    for a in body:
        v = a.value
        if isinstance(v, Sum):
            adds += len(v.terms) - (v.constant == 0)
            muls += sum(abs(w) != 1 for w, _ in v.terms)
        elif isinstance(v, Product):
            muls += len(v.factors) - 1 + (abs(v.coefficient) != 1)
        elif v.function in ("reciprocal", "pivot_inverse"):
            divs += 1
        elif v.function in ("sin", "cos"):
            angles.add(v.args)
        else:
            calls += 1
    muls += sum(abs(o.coefficient) != 1 for o in outputs if o.name)
    return Cost(adds, muls, divs, len(angles), calls)


# --- names ----------------------------------------------------------------------------------------


def _renamed(function: Function, hints: Mapping[str, str], reserved: frozenset[str]) -> Function:
    """Give readable names to values: those of the scene, sin_theta and the like, else w1, w2,
    ...
    """
    assigned: dict[str, str] = {}
    used_names = {*function.uses, *reserved}

    def assign_name(name: str, preferred: str) -> None:
        """Give a value the preferred name, with "_", "_2", "_3", ... appended if it is in use."""
        preferred = re.sub("__+", "_", preferred)
        stem, name_, number = preferred.rstrip("_"), preferred, 1
        while name_ in used_names:
            name_ = f"{stem}_{number}" if number > 1 else f"{stem}_"
            number += 1
        used_names.add(name_)
        assigned[name] = name_

    assignments = (*function.early, *function.body)
    for a in assignments:
        if a.name in hints:
            assign_name(a.name, hints[a.name])
    count = 0
    plain: set[str] = set()  # names without a meaning
    for a in assignments:
        if a.name in assigned:
            continue
        preferred = ""
        if isinstance(a.value, Call) and len(a.value.args) == 1:
            arg = a.value.args[0]
            inner = assigned.get(arg.name, arg.name)
            if arg.coefficient == 1 and inner not in plain:
                preferred = {"reciprocal": f"inv_{inner}"}.get(
                    a.value.function, f"{a.value.function}_{inner}"
                )
            elif len(parts := _leaves(function, arg)) > 1:
                preferred = f"{a.value.function}_{'_'.join(parts)}"
        if not preferred:
            count += 1
            preferred = f"w{count}"
            plain.add(preferred)
        assign_name(a.name, preferred)

    meaningful = {name for name, name_ in assigned.items() if name_.rstrip("_") not in plain}
    marked = replace(
        function,
        early=tuple(replace(a, named=a.name in meaningful) for a in function.early),
        body=tuple(replace(a, named=a.name in meaningful) for a in function.body),
    )
    return rename(marked, assigned)


def _leaves(function: Function, arg: Operand) -> tuple[str, ...]:
    """Return the names in a sum of two or three terms, for sin_q1_q2; () for other arguments."""
    for a in (*function.early, *function.body):
        if a.name == arg.name and isinstance(a.value, Sum) and len(a.value.terms) <= 3:
            names = a.value.names
            return () if any(n.startswith("_") for n in names) else names
    return ()
