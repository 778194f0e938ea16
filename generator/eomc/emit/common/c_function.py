"""C functions as data: their prototypes, calls, statements and definitions, and long lines."""

from __future__ import annotations

import re
import textwrap
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from eomc.emit.common.c_expression import Block, break_line

WIDTH = 100  # of a line


@dataclass(frozen=True)
class CArgument:
    """An argument of a C function, such as `const double q[CARTPOLE_NQ]`.

    extent: array size as C text; "" for numbers and pointers.
    """

    type: str
    name: str
    extent: str = ""

    @property
    def declaration(self) -> str:
        """The C declaration of the argument, as in a prototype."""
        gap = "" if self.type.endswith("*") else " "
        return f"{self.type}{gap}{self.name}" + (f"[{self.extent}]" if self.extent else "")


def input_array(type: str, name: str, extent: str = "") -> CArgument:
    """Return an argument of a C function for an array that the function only reads.

    `type` is the C type of an element and `extent` the size as C text. Without an extent, the
    argument is declared as a pointer.
    """
    return CArgument(f"const {type}" if extent else f"const {type} *", name, extent)


def output_array(type: str, name: str, extent: str = "") -> CArgument:
    """Return an argument of a C function for an array that the function writes.

    `type` is the C type of an element and `extent` the size as C text. Without an extent, the
    argument is declared as a pointer.
    """
    return CArgument(type if extent else f"{type} *", name, extent)


@dataclass(frozen=True)
class CFunction:
    """A C function as data, from which its prototype, definition and calls are printed.

    Attributes
    ----------
    result
        C type of the result.
    body
        Statements, with a blank line between blocks. Empty if a template contains them.
    reads
        Names of the arguments that the body reads.
    qualifier
        "static", or "" for public functions.
    doc
        Paragraphs of the comment above the function.
    """

    name: str
    result: str
    arguments: tuple[CArgument, ...]
    body: tuple[Block, ...] = ()
    reads: frozenset[str] = frozenset()
    qualifier: str = ""
    doc: tuple[str, ...] = ()

    @property
    def prototype(self) -> str:
        """Qualifier, result type, name and arguments as C text in one line, without a semicolon."""
        listed = ", ".join(a.declaration for a in self.arguments) or "void"
        words = (self.qualifier, self.result, f"{self.name}({listed})")
        return " ".join(w for w in words if w)

    @property
    def comment(self) -> str:
        """The C comment above the function, in one line if it fits."""
        if len(whole := " ".join(self.doc)) <= WIDTH - 6:
            return f"/* {whole} */"
        lines = [line for part in self.doc for line in textwrap.wrap(part, WIDTH - 3)]
        return "\n".join(["/*", *(f" * {line}" for line in lines), " */"])

    @property
    def unused(self) -> tuple[str, ...]:
        """Names of the arguments that the body does not read."""
        return tuple(a.name for a in self.arguments if a.name not in self.reads)

    @property
    def inside(self) -> str:
        """The C text between the braces of the function: the statements of the body, indented.

        They begin with a `(void)` cast of each argument that the body does not read.
        """
        unread = Block("", tuple(f"(void){name};" for name in self.unused))
        return "\n\n".join(block_text(b) for b in (unread, *self.body) if b.lines)

    @property
    def definition(self) -> str:
        """The C definition of the function as text: its prototype and its body.

        For functions with a qualifier (static), the comment precedes them.
        """
        head = [self.comment] if self.doc and self.qualifier else []
        return "\n".join([*head, self.prototype, "{", self.inside, "}"])

    @property
    def is_forward(self) -> bool:
        """Whether the body is one call of another function."""
        lines = [line for b in self.body for line in b.lines]
        return len(lines) == 1 and re.fullmatch(r"(return )?\w+\(.*\);", lines[0]) is not None

    def takes(self, name: str) -> bool:
        """Return True if the function has an argument called `name`."""
        return any(a.name == name for a in self.arguments)

    def call(self, **passed: str) -> str:
        """Return a C expression that calls the function.

        passed: C expressions of arguments, by the argument's name. Each other argument is passed as
        a variable of the same name.
        """
        return f"{self.name}({', '.join(passed.get(a.name, a.name) for a in self.arguments)})"

    def call_with(self, arguments: Sequence[str]) -> str:
        """Return the C call that is the body of this function, with the arguments of its call."""
        values = dict(zip((a.name for a in self.arguments), arguments, strict=True))
        call = self.body[0].lines[0].removeprefix("return ").removesuffix(";")
        return re.sub(r"\w+", lambda m: values.get(m[0], m[0]), call)


def static_prototype(name: str, result: str, *arguments: CArgument) -> CFunction:
    """Return the prototype of a static C function; a template contains its body.

    result: C type of the result.
    """
    return CFunction(name, result, arguments, qualifier="static")


@dataclass(frozen=True)
class GeneratedFunction:
    """A C function whose body is generated from a function of the eomc program, with its helpers.

    Attributes
    ----------
    function
        The C function itself.
    parts
        Static C functions that `function` calls: the pieces of a long function, or the function for
        one column of a matrix.
    values
        C definition of the struct with the intermediate values that the pieces share; "" for none.
    column_call, out, symmetric
        For matrix functions that loop over columns: the C call that computes one column, the name
        of the output array, and whether the matrix is symmetric.
    """

    function: CFunction
    parts: tuple[CFunction, ...] = ()
    values: str = ""
    column_call: str = ""
    out: str = ""
    symmetric: bool = False

    @property
    def text(self) -> str:
        """C text of the struct and of all functions, in the order in which C needs them.

        Not for functions that loop over columns: a template writes their loop around `column_call`.
        """
        texts = (self.values, *(f.definition for f in self.parts), self.function.definition)
        return "\n\n".join(filter(None, texts))


def block_text(block: Block) -> str:
    """Return the statements of a block as indented C text, after its comment if it has one."""
    lines = [f"/* {block.comment} */"] if block.comment else []
    return "\n".join(f"    {line}" for line in (*lines, *block.lines))


def prototypes(qualifier: str, text: str) -> list[str]:
    """Return the prototypes of the functions that a C text defines after a macro `qualifier`."""
    return re.findall(rf"^{qualifier} ([^{{;]*\))\n\{{", text, re.MULTILINE)


# --- statements -----------------------------------------------------------------------------------


def define_constant(type: str, name: str, value: str) -> str:
    """Return the C definition of a constant local variable: `const type name = value;`."""
    return f"const {type} {name} = {value};"


def declare(type: str, name: str) -> str:
    """Return the C declaration of a local variable: `type name;`."""
    return f"{type} {name};"


def assign(place: str, value: str) -> str:
    """Return the C statement that assigns the expression `value` to the variable `place`."""
    return f"{place} = {value};"


def call_statement(call: str) -> str:
    """Return a C call as a statement, with its semicolon."""
    return f"{call};"


def return_statement(value: str) -> str:
    """Return a C return statement."""
    return f"return {value};"


def return_case(value: str, results: Mapping[str, str]) -> tuple[str, ...]:
    """Return the lines of a C statement that returns the result that belongs to a value.

    results: C expressions by constants that the value may have; the last one belongs to all others.
    """
    *others, last = results.items()
    if not others:
        return (return_statement(last[1]),)
    lines = [line for k, x in others for line in (f"case {k}:", f"    {return_statement(x)}")]
    return (f"switch ({value}) {{", *lines, "default:", f"    {return_statement(last[1])}", "}")


def record_failures(conditions: Iterable[str]) -> tuple[str, ...]:
    """Return C statements that record failures in the variable `failed`, a bit mask.

    Each statement combines `failed` with one of the conditions by "or".
    """
    return tuple(f"failed |= {text};" for text in conditions)


def return_if(conditions: Iterable[str], value: str) -> tuple[str, ...]:
    """Return the lines of a C statement that returns `value` if one of the conditions holds.

    Returns no lines if there are no conditions.
    """
    text = " || ".join(conditions)
    return (f"if ({text})", f"    return {value};") if text else ()


def signal_if_null(array: str, call: str) -> tuple[str, ...]:
    """Return the lines of a C statement that computes the inputs u if u is NULL.

    The scene's signals (functions of time and state) define the inputs. `call` is a C call that
    stores their values in `array`.
    """
    return ("if (!u) {", f"    {call};", f"    u = {array};", "}")


def compute_if_null(name: str, local: str, call: str) -> tuple[str, ...]:
    """Return the lines of a C statement that calls `call` if the pointer `name` is NULL.

    The call stores its result in the variable `local`, to which `name` then points.
    """
    return (f"if (!{name}) {{", f"    {call};", f"    {name} = &{local};", "}")


def define_array(type: str, name: str, extent: str, values: Sequence[str]) -> str:
    """Return the C definition of a constant array with the given elements.

    type: C type of an element. extent: size of the array as C text.
    """
    return f"const {type} {name}[{extent}] = {{ {', '.join(values)} }};"


def member(of: str, name: str) -> str:
    """Return the C expression `of->name`, a member of a struct behind a pointer."""
    return f"{of}->{name}"


def cast(type: str, name: str) -> str:
    """Return a C expression that casts the pointer `name` to `const type *`."""
    return f"(const {type} *){name}"


def define_struct(type: str, real: str, members: Sequence[str]) -> str:
    """Return the C definition of a struct called `type`.

    real: C type of all members. members: their declarators, such as "x" or "x[3]".
    """
    return f"typedef struct {{\n    {real} {', '.join(members)};\n}} {type};"


def copy_loop(to: str, array: str, first: int, count: str) -> tuple[str, ...]:
    """Return the lines of a C loop that copies `count` elements of `array` to the array `to`.

    The first copied element is `array[first]`; it becomes `to[0]`.
    """
    index = f"{first} + k" if first else "k"
    return (f"for (int k = 0; k < {count}; k++)", f"    {to}[k] = {array}[{index}];")


def initialiser_rows(rows: Iterable[Sequence[str]]) -> tuple[str, ...]:
    """Return the rows of a matrix as lines of a C initialiser, such as "{ 1.0, 2.0 },"."""
    return tuple("{ " + ", ".join(row) + " }," for row in rows)


def initialiser(values: Iterable[str]) -> str:
    """Return a C initialiser such as "{ u, p }", or "" if there are no values."""
    text = ", ".join(values)
    return f"{{ {text} }}" if text else ""


def define_table(
    name: str, sizes: Sequence[int], lines: Sequence[str], comment: str = "", type: str = "real"
) -> str:
    """Return the C definition of a constant array, by default of the library's type `real`.

    sizes: the number of elements in each dimension. lines: the lines of the initialiser. comment:
    text of the comment above the definition; "" for none.
    """
    extents = "".join(f"[{size}]" for size in sizes)
    body = "\n".join(["{", *(f"    {line}" for line in lines), "}"])
    if len(lines) == 1:
        body = f"{{ {lines[0]} }}"
    above = f"/* {comment} */\n" if comment else ""
    return f"{above}static const {type} {name}{extents} = {body};"


def define_int_table(
    name: str, values: Sequence[int] | Sequence[Sequence[int]], comment: str = ""
) -> str:
    """Return the C definition of a constant array or matrix of integers."""
    rows = [v if isinstance(v, Sequence) else (v,) for v in values]
    sizes = [len(values)]
    lines: Sequence[str] = [", ".join(str(x) for row in rows for x in row)]
    if isinstance(values[0], Sequence):
        sizes.append(len(rows[0]))
        lines = initialiser_rows([str(x) for x in row] for row in rows)
    return define_table(name, sizes, lines, comment, "int")


def break_comments(text: str) -> str:
    """Return the text of a C file with its comments broken to lines of at most WIDTH characters.

    A long comment behind code is moved above the code if possible.
    """
    lines, result_lines, inside = text.split("\n")[::-1], list[str](), False
    while lines:
        line = lines.pop()
        before_comment, mark_, comment_text = line.partition("/*")
        margin = " " * (len(line) - len(line.lstrip(" ")))
        if len(line) > WIDTH and "Generated by" not in line:
            if (
                not inside
                and before_comment.strip()
                and comment_text.endswith("*/")
                and _may_move_above(before_comment.lstrip())
            ):
                lines += [before_comment.rstrip(), f"{margin}/*{comment_text}"]
                continue
            if inside or (mark_ and not before_comment.strip()):
                line, rest = _split_comment(line)
                continuation = f"{margin}* " if inside else f"{margin} * "
                if lines and not rest.endswith((".", "*/")) and lines[-1].startswith(continuation):
                    rest += " " + lines.pop().removeprefix(continuation)
                lines += [continuation + rest] if rest else []
        inside = line.rfind("/*") > line.rfind("*/") or (inside and "*/" not in line)
        result_lines.append(line)
    return "\n".join(result_lines)


def _may_move_above(code: str) -> bool:
    """Return True if a comment may be moved above this code."""
    return not code.startswith(("#", "}", "else"))


def _split_comment(line: str) -> tuple[str, str]:
    """Split a comment line into what fits and the rest."""
    break_position = line.rfind(" ", 0, min(WIDTH + 1, len(line.removesuffix(" */"))))
    text_start = len(line) - len(line.lstrip(" /*"))
    return (
        (line[:break_position], line[break_position + 1 :])
        if break_position >= text_start
        else (line, "")
    )


def break_long_lines(text: str) -> str:
    """Return the text of a C file with long lines broken to at most WIDTH characters.

    Comments and statements are broken; preprocessor directives are not.
    """
    result_lines: list[str] = []
    for line in break_comments(text).split("\n"):
        inside = line.lstrip(" ")
        if len(line) <= WIDTH or inside.startswith(("* ", "/*", "#")) or line.endswith("*/"):
            result_lines.append(line)
            continue
        width = len(line) - len(inside)
        head, parenthesis, rest = inside.partition("(")
        if parenthesis and ", " not in inside[: WIDTH - width] and len(head) < WIDTH - width:
            result_lines.append(" " * width + head + parenthesis)
            parts = [" " * 4 + part.lstrip() for part in break_line(rest, WIDTH - width - 4)]
        else:
            parts = list(break_line(inside, WIDTH - width))
        result_lines += [" " * width + part.rstrip() for part in parts]
    return "\n".join(result_lines)
