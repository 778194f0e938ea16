"""Renaming of scene names that C code cannot use: macros of headers, and functions that are called.

Names of a program become struct members, enumerators and local variables next to the definitions of
the C library, Python.h and users' headers. Names that may be macros get a trailing "_", which no
scene name has, and the header lists them. Python keeps the author's names.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import replace

from eomc.base.names import MATHEMATICS
from eomc.model.symbols import ALONG
from eomc.program.ir import rename
from eomc.program.program import Program

# Most macros have three capitals and no small letter. The others of glibc and Python follow.
_SHOUTED = re.compile(r"[^a-z]*[A-Z][^a-z]*[A-Z][^a-z]*[A-Z][^a-z]*")
_OTHERS = re.compile(
    r"M_(\d_)?(E|PI|SQRT|LN|LOG)\w*|Py\w*|(PRI|SCN)[bdioux]\w*|L_(ctermid|cuserid|tmpnam)|P_tmpdir|"
    r"errno|math_errhandling|std(in|out|err)|st_[acm]time|sched_priority|static_assert|complex|"
    r"imaginary|I|noreturn|true|false|s[ai]_\w+|linux|unix|near|far|small|interface|"
    r"B(0|[1-9]\d{1,6})|(BS|FF|NL|VT)[01]|CR[0-3]|CS[5-8]"  # <termios.h>
)

# Prefixes of macros, with which an enumerator of a scene could coincide
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
    """Return True if a header of the C library or of Python may define a macro with this name."""
    return bool(_SHOUTED.fullmatch(name) or _OTHERS.fullmatch(name))


def may_be_enumerator_of_others(name: str) -> bool:
    """Return True if an enumerator of a scene may coincide with a macro of a header.

    The headers are those of the C library and of Python. name: the enumerator, which begins with
    the scene's name.
    """
    return not name.endswith("_") and bool(_FAMILY.fullmatch(name))


def in_c(name: str, prefix: str) -> str:
    """Return the C name for the name of a coordinate, parameter or input of the scene.

    It is the same name, with "_" appended if C cannot use it. prefix: the scene's name, with which
    other C names begin.
    """
    ours = name.lower().startswith(prefix.lower() + "_")
    return name + "_" if ours or may_be_macro(name) or name in _CALLED else name


def rename_for_c(program: Program) -> tuple[Program, Mapping[str, str]]:
    """Return the program with names that C can use, and a mapping of the changed names.

    The mapping leads from each new name of a coordinate, parameter or input to its name in the
    scene.
    """
    system = program.system
    declared = [c.name for c in system.coordinates]
    declared += [p.name for p in system.parameters] + [i.name for i in system.inputs]
    c_names = {name: in_c(name, system.name) for name in declared}
    renamed_to = {name: c_name for name, c_name in c_names.items() if c_name != name}
    new = dict(_derived(renamed_to))
    for function in program.functions.values():
        for a in (*function.early, *function.body):
            if (c_name := in_c(a.name, system.name)) != a.name:
                new.setdefault(a.name, c_name)
    if not new:
        return program, {}
    renamed = replace(
        system,
        coordinates=tuple(replace(c, name=c_names[c.name]) for c in system.coordinates),
        parameters=tuple(replace(p, name=c_names[p.name]) for p in system.parameters),
        inputs=tuple(replace(i, name=c_names[i.name]) for i in system.inputs),
        renamed=(*system.renamed, *renamed_to.items()),
    )
    functions = {name: rename(f, new) for name, f in program.functions.items()}
    written = {c_name: name for name, c_name in renamed_to.items()}
    return replace(program, system=renamed, functions=functions), written


def _derived(renamed_to: Mapping[str, str]) -> Iterator[tuple[str, str]]:
    """Yield the pairs of names, also for velocities, accelerations and directions."""
    for name, c_name in renamed_to.items():
        for ending in ("", "_dot", "_ddot"):
            yield name + ending, c_name + ending
            yield name + ending + ALONG, c_name + ending + ALONG
