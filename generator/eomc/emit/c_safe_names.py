"""Names of a scene that C can't bear as they stand: macros of headers, functions that are called.

A program's names reach C as struct members, enumerators and local variables, beside whatever the
C library, Python.h or a user's own headers define. Those that may be macros there get a "_"
behind, which no name of a scene has, and the header says so; Python keeps the author's names.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import replace

from eomc.base.names import MATHEMATICS
from eomc.model.symbols import ALONG
from eomc.program.ir import rename
from eomc.program.program import Program

# macros are shouted: three capitals and no small letter. The rest of glibc's and Python's
_SHOUTED = re.compile(r"[^a-z]*[A-Z][^a-z]*[A-Z][^a-z]*[A-Z][^a-z]*")
_OTHERS = re.compile(
    r"M_(\d_)?(E|PI|SQRT|LN|LOG)\w*|Py\w*|(PRI|SCN)[bdioux]\w*|L_(ctermid|cuserid|tmpnam)|P_tmpdir|"
    r"errno|math_errhandling|std(in|out|err)|st_[acm]time|sched_priority|static_assert|complex|"
    r"imaginary|I|noreturn|true|false|s[ai]_\w+|linux|unix|near|far|small|interface|"
    r"B(0|[1-9]\d{1,6})|(BS|FF|NL|VT)[01]|CR[0-3]|CS[5-8]"  # <termios.h>
)

# words that macros begin with; an enumerator of a scene that is called so could be one of them
_FAMILY = re.compile(
    "(?:ADJ|AIO|ALIGNOF|ATOMIC|BC|CHAR|CHARCLASS|CLOCKS?|CLONE|CLOSE|COLL|CPU|DBL|DELAYTIMER|ENABLE|"
    "EXIT|EXPR|FD|FE|FILENAME|FLT|FOPEN|FP|FV[CS]|HAVE|HUGE|IOV|ITIMER|LC|LDBL|MATH|MAX|MB|METH|MOD|"
    r"MQ|NGROUPS|NL|PIPE|PTHREAD|PY\w*|RAND|RE|RENAME|RTSIG|SCHED|SEEK|SEM|SIG|SIZEOF|STA|STATX|"
    r"STD(?:C|ERR|IN|OUT)|SYS|TIMER?|TMP|TTY|UTIME|WCHAR|WINT|WITH|XATTR|S?SIZE|SCHAR|SHRT|LL?ONG|INT\d*|INTMAX|INTPTR|"
    r"PTRDIFF|UCHAR|USHRT|UL?LONG|UINT\d*|UINTMAX|UINTPTR)_\w+|"
    r"(?:BIG|LITTLE|PDP)_ENDIAN|BYTE_ORDER|BOOL_(?:MAX|WIDTH)|(?:HOST_|LOGIN_)?NAME_MAX|LINE_MAX|"
    r"PATH_MAX|(?:NO)?WAIT_LOCK|WORD_BIT|WINDOW_HAS_FLAGS|MAJOR_IN_\w+|MVWDELCH_\w+|DOUBLE_IS_\w+|"
    r"[FRWX]_OK|F_T?LOCK|F_TEST|F_ULOCK|L_(?:SET|INCR|XTND)|S_I[A-Z]{3,}|S_BLKSIZE|"
    r"M_(?:\d_)?(?:E|PI|SQRT|LN|LOG)\w*"
)

_CALLED = frozenset(name + suffix for name in MATHEMATICS for suffix in ("f", "l", "q"))


def may_be_macro(name: str) -> bool:
    """Whether some header may define a macro of this name."""
    return bool(_SHOUTED.fullmatch(name) or _OTHERS.fullmatch(name))


def may_be_enumerator_of_others(name: str) -> bool:
    """The same of a name with the scene's in front, in capitals; no macro ends in a "_"."""
    return not name.endswith("_") and bool(_FAMILY.fullmatch(name))


def in_c(name: str, prefix: str) -> str:
    """The name as C has it, in a scene of this prefix."""
    ours = name.lower().startswith(prefix.lower() + "_")
    return name + "_" if ours or may_be_macro(name) or name in _CALLED else name


def borne(program: Program) -> tuple[Program, Mapping[str, str]]:
    """The program with names that C can bear, and the author's name of each coordinate,
    parameter and input that is called otherwise there.
    """
    system = program.system
    declared = [c.name for c in system.coordinates]
    declared += [p.name for p in system.parameters] + [i.name for i in system.inputs]
    wishes = {name: in_c(name, system.name) for name in declared}
    other = {name: used for name, used in wishes.items() if used != name}
    new = dict(_derived(other))
    for function in program.functions.values():
        for a in (*function.early, *function.body):
            if (used := in_c(a.name, system.name)) != a.name:
                new.setdefault(a.name, used)
    if not new:
        return program, {}
    renamed = replace(
        system,
        coordinates=tuple(replace(c, name=wishes[c.name]) for c in system.coordinates),
        parameters=tuple(replace(p, name=wishes[p.name]) for p in system.parameters),
        inputs=tuple(replace(i, name=wishes[i.name]) for i in system.inputs),
        renamed=(*system.renamed, *other.items()),
    )
    functions = {name: rename(f, new) for name, f in program.functions.items()}
    written = {used: name for name, used in other.items()}
    return replace(program, system=renamed, functions=functions), written


def _derived(other: Mapping[str, str]) -> Iterator[tuple[str, str]]:
    """The names, with those of rates and of directions along them."""
    for name, used in other.items():
        for behind in ("", "_dot", "_ddot"):
            yield name + behind, used + behind
            yield name + behind + ALONG, used + behind + ALONG
