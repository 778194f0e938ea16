"""Assignments of one function while they are simplified and put in order."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping

from eomc.derive.tape import Stage
from eomc.program.ir import Assignment, Operand, Product, Sum, Value, renamed_value


class ScheduleBuilder:
    """The assignments of one function while they are simplified and put in order.

    Attributes
    ----------
    values
        The right-hand side of each name.
    stages
        The binding time (see `Stage`) of each name.
    hints
        For some of the names: a preferred name in the generated code.
    known
        The name of each right-hand side; the inverse of `values`.
    """

    def __init__(self) -> None:
        self.values: dict[str, Value] = {}
        self.stages: dict[str, Stage] = {}
        self.hints: dict[str, str] = {}
        self.known: dict[Value, str] = {}
        self.made = 0

    def new(self, value: Value) -> str:
        """Return the name of a right-hand side. If it has none, add it under a new name."""
        if value not in self.known:
            self.made += 1
            self.put(f"_n{self.made:06d}", value)
        return self.known[value]

    def put(self, name: str, value: Value) -> None:
        """Set the right-hand side `value` of a name, and its binding time."""
        old = self.values.get(name)
        if old is not None:
            if old == value:
                return
            if self.known.get(old) == name:
                del self.known[old]
        self.values[name] = value
        self.known.setdefault(value, name)
        self.stages[name] = self.stage(value)

    def stage(self, value: Value) -> Stage:
        """Return the binding time of a right-hand side: when it can be computed."""
        return max((self.stages[n] for n in value.names), default=Stage.NUMBER)

    def uses(self, ends: Iterable[Operand]) -> Counter[str]:
        """Return how often each name is read, by right-hand sides and by the results `ends`."""
        uses: Counter[str] = Counter(o.name for o in ends if o.name)
        for value in self.values.values():
            uses.update(value.names)
        return uses

    def drop(self, ends: Iterable[Operand]) -> None:
        """Remove the values that none of the results `ends` depends on."""
        needed: set[str] = set()
        queue = [o.name for o in ends if o.name]
        while queue:
            name = queue.pop()
            if name in self.values and name not in needed:
                needed.add(name)
                queue.extend(self.values[name].names)
        self.values = {n: v for n, v in self.values.items() if n in needed}
        self.known = {v: n for n, v in reversed(self.values.items())}

    def sort(self) -> None:
        """Put definitions before their uses, and update their binding times."""
        self.values = {name: self.values[name] for name in _in_order(self.values)}
        for name, value in self.values.items():
            self.stages[name] = self.stage(value)

    def assignments(self, ends: list[Operand]) -> list[Assignment]:
        """Return the assignments, sorted by binding time and without copies of other values.

        `ends` are the results of the function; names of copies in them are replaced.
        """
        aliases: dict[str, Operand] = {}
        for name, value in self.values.items():
            single: Operand | None = None
            if isinstance(value, Product) and len(value.factors) == 1:
                single = Operand(value.coefficient, value.factors[0])
            elif isinstance(value, Sum) and len(value.terms) == 1 and value.constant == 0:
                single = Operand(*value.terms[0])
            if single is not None and single.coefficient == 1:
                aliases[name] = aliases.get(single.name, single)

        def real(name: str) -> str:
            """Return the name that an alias stands for."""
            return aliases[name].name if name in aliases else name

        for name, value in list(self.values.items()):
            self.values[name] = renamed_value(value, real)
        ends[:] = [Operand(o.coefficient, real(o.name)) for o in ends]
        self.hints = {real(n): h for n, h in self.hints.items()}
        for alias in aliases:
            del self.values[alias]
        self.drop(ends)
        self.sort()
        ordered = [Assignment(n, v, self.stages[n]) for n, v in self.values.items()]
        return sorted(ordered, key=lambda a: a.stage)


def _in_order(values: Mapping[str, Value]) -> list[str]:
    """Sort names topologically, otherwise in the given order."""
    sorted_names: dict[str, None] = {}
    for start in values:
        stack = [start]
        while stack:
            name = stack[-1]
            missing = [n for n in values[name].names if n in values and n not in sorted_names]
            if missing:
                stack.extend(reversed(missing))
            else:
                sorted_names.setdefault(name)
                stack.pop()
    return list(sorted_names)
