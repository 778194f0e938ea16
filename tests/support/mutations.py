"""Small changes of a source, each in one place: of C, of templates, of Python.

A change concerns a sign, an operator, a comparison, a factor, a constant, an index, a condition, a
loop, a returned value or a whole statement.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

# a pattern, and its replacements
CHANGES: Sequence[tuple[str, Sequence[str]]] = (
    (r"(?<=[\w)\]]) \+ (?=[\w(-])", (" - ", " * ")),
    (r"(?<=[\w)\]]) - (?=[\w(])", (" + ",)),
    (r"(?<=[\w)\]])\*(?=[\w(])", (" + ", "/")),
    (r"(?<== )-(?=[\w(])", ("",)),
    (r"(?<=return )-(?=[\w(])", ("",)),
    (r"\+=", ("-=", "=")),
    (r"-=", ("+=",)),
    (r"&=", ("|=", "=")),
    (r" <= ", (" > ", " < ")),
    (r" >= ", (" < ", " > ")),
    (r" < ", (" <= ", " >= ")),
    (r" > ", (" <= ", " >= ")),
    (r" == ", (" != ",)),
    (r" != ", (" == ",)),
    (r" && ", (" || ",)),
    (r" \|\| ", (" && ",)),
    (r"(?<=[(\s])!(?=[\w(])", ("",)),
    (r"(?<![\w.])\d+\.\d+(?:e[+-]?\d+)?(?![\w.])", ("number",)),
    (r"(?<=\[)\d+(?=\])", ("index",)),
    (r"(?<![\w.\[{])\d+(?![\w.\]}])", ("whole",)),
    (r"\bsin_(?=\w)", ("cos_",)),
    (r"\bcos_(?=\w)", ("sin_",)),
    (r"\+\+|--", ("other",)),
)


@dataclass(frozen=True)
class Mutant:
    """A change of a source: the characters from `at` to `end` become `new`."""

    at: int
    end: int
    new: str

    def apply(self, source: str) -> str:
        """Return the changed source."""
        return source[: self.at] + self.new + source[self.end :]


def of_c(source: str) -> list[Mutant]:
    """Return all mutants of the code, without comments, #if, prototypes and declared sizes."""
    return _of_lines(_code(source))


def _of_lines(lines: Iterable[tuple[int, str]]) -> list[Mutant]:
    mutants = []
    for start, line in lines:
        for pattern, changes in CHANGES:
            for match in re.finditer(pattern, line):
                for change in changes:
                    new = _changed(match[0], change)
                    if new != match[0]:
                        mutants.append(Mutant(start + match.start(), start + match.end(), new))
    return mutants


def _changed(old: str, change: str) -> str:
    if change == "number":
        return repr(float(old) * 1.5 if float(old) else 1.0)
    if change in ("index", "whole"):
        return str(int(old) + 1 if int(old) == 0 else int(old) - 1)
    if change == "other":
        return "--" if old == "++" else "++"
    return change


def _code(source: str) -> Iterator[tuple[int, str]]:
    """Yield lines inside functions, with blanked comments, and their positions."""
    blank = re.sub(r"/\*.*?\*/", lambda m: re.sub(r"[^\n]", " ", m[0]), source, flags=re.S)
    inside, at, skipped, depth = False, 0, False, 0
    for line in blank.splitlines(keepends=True):
        if line.startswith("#"):
            # code that this compiler skips
            if line.startswith(("#if", "#ifdef", "#ifndef")):
                depth += 1
            elif line.startswith("#endif"):
                depth -= 1
            skipped = (depth > 0 and line.startswith("#else")) or (skipped and depth > 0)
        elif line.startswith("{"):
            inside = True
        elif line.startswith("}"):
            inside = False
        elif inside and not skipped:
            yield at, line
        at += len(line)


# --- templates and handwritten C ------------------------------------------------------------------

TAG = re.compile(r"{[{%#].*?[}%#]}", re.S)
CONDITION = re.compile(r"{%-? *(?:el)?if (.*?) *-?%}")
STATEMENT = re.compile(
    r"^ +(?:(?:{{[^}]*}}|[^\s={])+ [-+*/|&]?= |\w+\(|break|continue|return|\*).*;", re.M
)


def of_template(source: str) -> list[Mutant]:
    """Return all mutants of what the template writes and of its conditions, and removed
    statements.
    """
    bare = TAG.sub(lambda m: re.sub(r"[^\n]", "\0", m[0]), source)
    bare = re.sub(r"/\*.*?\*/", lambda m: re.sub(r"[^\n]", "\0", m[0]), bare, flags=re.S)
    lines, at = [], 0
    for line in bare.splitlines(keepends=True):
        if not line.startswith("#"):
            lines.append((at, line))
        at += len(line)
    mutants = _of_lines(lines)
    for match in STATEMENT.finditer(source):
        if bare[match.start() : match.end()].strip("\0 "):
            mutants.append(Mutant(match.start(), match.end(), ""))
    for match in CONDITION.finditer(source):
        mutants.append(Mutant(*match.span(1), f"not ({match[1]})"))
        for here in re.finditer(r" (and|or) ", match[1]):
            other = " or " if here[1] == "and" else " and "
            start = match.start(1)
            mutants.append(Mutant(start + here.start(), start + here.end(), other))
    return mutants


# --- Python ---------------------------------------------------------------------------------------

OPERATORS: dict[type[ast.operator], tuple[str, str]] = {
    ast.Add: ("+", "-"), ast.Sub: ("-", "+"), ast.Mult: ("*", "/"), ast.Div: ("/", "*"),
    ast.FloorDiv: ("//", "*"), ast.Mod: ("%", "*"), ast.Pow: ("**", "*"), ast.BitAnd: ("&", "|"),
    ast.BitOr: ("|", "&"), ast.MatMult: ("@", "*"),
}  # fmt: skip
COMPARISONS: dict[type[ast.cmpop], tuple[str, tuple[str, ...]]] = {
    ast.Eq: ("==", ("!=",)), ast.NotEq: ("!=", ("==",)), ast.Lt: ("<", ("<=", ">")),
    ast.LtE: ("<=", ("<", ">")), ast.Gt: (">", (">=", "<")), ast.GtE: (">=", (">", "<")),
    ast.Is: ("is", ("is not",)), ast.IsNot: ("is not", ("is",)),
    ast.In: ("in", ("not in",)), ast.NotIn: ("not in", ("in",)),
}  # fmt: skip
FUNCTIONS = {"min": "max", "max": "min", "any": "all", "all": "any", "sorted": "list"}


def of_python(source: str) -> list[Mutant]:
    """Return all mutants, except of types, imports, docstrings and messages."""
    return _Python(source).found


class _Python(ast.NodeVisitor):
    def __init__(self, source: str) -> None:
        self.source, self.found = source, list[Mutant]()
        self.lines = source.splitlines(keepends=True)
        self.starts = [0]
        for line in self.lines:
            self.starts.append(self.starts[-1] + len(line))
        self.visit(ast.parse(source))

    def place(self, line: int, column: int) -> int:
        """Return a position in characters; ast counts bytes."""
        return self.starts[line - 1] + len(self.lines[line - 1].encode()[:column].decode())

    def span(self, node: ast.AST) -> tuple[int, int]:
        assert isinstance(node, (ast.expr, ast.stmt))
        assert node.end_lineno is not None and node.end_col_offset is not None
        start = self.place(node.lineno, node.col_offset)
        return start, self.place(node.end_lineno, node.end_col_offset)

    def text(self, node: ast.AST) -> str:
        start, end = self.span(node)
        return self.source[start:end]

    def put(self, node: ast.AST, new: str) -> None:
        """Replace the whole node."""
        self.found.append(Mutant(*self.span(node), new))

    def between(self, left: ast.AST, right: ast.AST, old: str, new: str) -> None:
        """Replace an operator."""
        start, end = self.span(left)[1], self.span(right)[0]
        at = self.source.index(old, start, end)
        self.found.append(Mutant(at, at + len(old), new))

    # --- skipped nodes -----

    def visit_arg(self, node: ast.arg) -> None:
        """Skip its type."""

    def visit_AnnAssign(self, node: ast.AnnAssign) -> None:
        if node.value:
            self.visit(node.value)

    def visit_Assign(self, node: ast.Assign) -> None:
        alias = isinstance(node.value, (ast.Subscript, ast.BinOp)) and node.col_offset == 0
        if alias and re.match(r"[A-Z][a-z]", self.text(node)):  # a type
            return
        self.generic_visit(node)
        if isinstance(node.targets[0], (ast.Attribute, ast.Subscript)):
            self.put(node, "pass")

    def visit_FunctionDef(self, node: ast.FunctionDef) -> None:
        for part in (*node.args.defaults, *filter(None, node.args.kw_defaults), *node.body):
            self.visit(part)

    def visit_ClassDef(self, node: ast.ClassDef) -> None:
        for part in node.body:
            self.visit(part)

    def visit_keyword(self, node: ast.keyword) -> None:
        if node.arg != "strict":  # an assertion
            self.visit(node.value)

    def visit_If(self, node: ast.If) -> None:
        if ast.unparse(node.test) != "TYPE_CHECKING":
            self.put(node.test, f"not ({self.text(node.test)})")
            self.generic_visit(node)

    # --- changed nodes -

    def visit_IfExp(self, node: ast.IfExp) -> None:
        self.put(node.test, f"(not ({self.text(node.test)}))")
        self.generic_visit(node)

    def visit_comprehension(self, node: ast.comprehension) -> None:
        for test in node.ifs:
            self.put(test, "True")
        self.generic_visit(node)

    def visit_Compare(self, node: ast.Compare) -> None:
        for left, op, right in zip(
            (node.left, *node.comparators), node.ops, node.comparators, strict=False
        ):
            old, news = COMPARISONS[type(op)]
            for new in news:
                self.between(left, right, old, new)
        self.generic_visit(node)

    def visit_BinOp(self, node: ast.BinOp) -> None:
        texts = (ast.JoinedStr, ast.Constant)
        if type(node.op) in OPERATORS and not any(
            isinstance(side, texts) and isinstance(getattr(side, "value", ""), str)
            for side in (node.left, node.right)
        ):
            self.between(node.left, node.right, *OPERATORS[type(node.op)])
        self.generic_visit(node)

    def visit_AugAssign(self, node: ast.AugAssign) -> None:
        if type(node.op) in OPERATORS:
            self.between(node.target, node.value, *OPERATORS[type(node.op)])
        self.put(node, "pass")
        self.generic_visit(node)

    def visit_BoolOp(self, node: ast.BoolOp) -> None:
        old, new = ("and", "or") if isinstance(node.op, ast.And) else ("or", "and")
        for left, right in pairwise(node.values):
            self.between(left, right, old, new)
        self.generic_visit(node)

    def visit_UnaryOp(self, node: ast.UnaryOp) -> None:
        if isinstance(node.op, (ast.Not, ast.USub)):
            self.put(node, f"({self.text(node.operand)})")
        self.generic_visit(node)

    def visit_Constant(self, node: ast.Constant) -> None:
        if isinstance(node.value, bool):
            self.put(node, str(not node.value))
        elif isinstance(node.value, int):
            self.put(node, str(node.value + 1))
        elif isinstance(node.value, float):
            self.put(node, repr(node.value * 1.5 if node.value else 1.0))

    def visit_JoinedStr(self, node: ast.JoinedStr) -> None:
        """Skip it: its positions are not known before Python 3.12."""

    def visit_Call(self, node: ast.Call) -> None:
        if isinstance(node.func, ast.Name) and node.func.id in FUNCTIONS:
            self.put(node.func, FUNCTIONS[node.func.id])
        self.generic_visit(node)

    def visit_For(self, node: ast.For) -> None:
        self.put(node.iter, f"list({self.text(node.iter)})[1:]")
        self.put(node.iter, f"list({self.text(node.iter)})[:-1]")
        self.generic_visit(node)

    def visit_Expr(self, node: ast.Expr) -> None:
        if not isinstance(node.value, (ast.Constant, ast.Yield, ast.YieldFrom)):
            self.put(node, "pass")
        if not isinstance(node.value, ast.Constant):
            self.generic_visit(node)

    def visit_Raise(self, node: ast.Raise) -> None:
        self.put(node, "pass")
        self.generic_visit(node)

    def visit_Assert(self, node: ast.Assert) -> None:
        """Skip assertions."""

    def visit_Return(self, node: ast.Return) -> None:
        if node.value is not None and not isinstance(node.value, ast.Constant):
            self.put(node, "return None")
        self.generic_visit(node)

    def visit_Continue(self, node: ast.Continue) -> None:
        self.put(node, "pass")

    def visit_Break(self, node: ast.Break) -> None:
        self.put(node, "pass")
