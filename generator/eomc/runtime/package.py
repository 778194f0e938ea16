"""Built packages as values: pickles of packages and results, and refusal of assignments.

A parameter is an argument of a call. One that is assigned to the module would change nothing, or
replace a function, so assignments raise AttributeError. A test that needs an assignment writes to
the dictionary of the module: `vars(module)["simulate"] = ...`.
"""

from __future__ import annotations

import functools
import sys
import warnings
from collections.abc import Callable, Iterable, Mapping
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any, ClassVar, NamedTuple, NoReturn

# How another process locates this package if its name cannot be imported: (function, place), set
# by the loader.
unpickler: tuple[Callable[..., Any], tuple[str, ...]] | None = None

# the built package, such as "cartpole"; "eomc" within the generator, which is no build
_BUILT = str(__package__).rpartition(".")[0]
# paths of the code of a build, relative to the package; all other pickled values are data
MODULE, MODEL, COMPONENT = "_self", "_model.itself", "_model.component"


class Identity(NamedTuple):
    """Identity of a build (a compiled package); each pickled value contains that of its build.

    Attributes
    ----------
    extension : str
        Name of the extension module; it ends with the digest of the build.
    digest : str
        Digest of the scene.
    dtype : str
        Number type, such as "float64".
    coordinates, parameters, inputs, events : tuple of str
        Names, in the order of the columns and indices of stored values.
    """

    extension: str
    digest: str
    dtype: str
    coordinates: tuple[str, ...]
    parameters: tuple[str, ...]
    inputs: tuple[str, ...]
    events: tuple[str, ...]


@functools.cache
def identity() -> tuple[Any, ...]:
    """Return the fields of the `Identity` of this build as a plain tuple, which any build can read.

    Returns () within the package eomc itself, which is not a build.
    """
    package: Any = import_module(_BUILT)
    if (model := getattr(package, "_model", None)) is None:
        return ()
    return (
        package._extension.__name__.rpartition(".")[2], model.info.digest, model.info.dtype.name,
        model.info.coordinates, model.info.parameters, model.info.inputs, model.info.events,
    )  # fmt: skip


def own_model() -> Any:
    """Return the `Model` of the built package to which this module belongs."""
    return model_of(import_module(_BUILT))


def model_of(package: ModuleType) -> Any:
    """Return the `Model` of a built package; None if the module is not a built package."""
    return getattr(package, "_model", None)


def reduced(path: str, *arguments: Any) -> tuple[Any, ...]:
    """Return the result of `__reduce__` for an object that `call_path(path, arguments)` creates.

    path: name of a function or class relative to this package, such as "status.MotionError".
    arguments: arguments of the call that creates the object again when the pickle is read.
    """
    if unpickler is None:
        return unpickled, (identity(), path, arguments)
    function, place = unpickler
    return function, (place, identity(), path, arguments)


class Component:
    """Part of a `Model`. It belongs to a build and is pickled by its name.

    path: attribute of the model that contains the part.
    """

    path: ClassVar[str]

    def __reduce__(self) -> tuple[Any, ...]:
        return reduced(COMPONENT, self.path)


def call_path(path: str, arguments: tuple[Any, ...]) -> Any:
    """Call a function or class of this package by its name and return the result.

    path: the name relative to this package, such as "status.MotionError". arguments: arguments of
    the call.
    """
    return _located(path)(*arguments)


def _located(path: str) -> Any:
    """Return a function or class of this package by its name, as in `call_path`."""
    first, *rest = path.split(".")
    if first.startswith("_"):  # an attribute of the built package, not a module of its runtime
        start, names = import_module(_BUILT), [first, *rest]
    else:
        start, names = import_module(f"{__package__}.{first}"), rest
    return functools.reduce(getattr, names, start)


def unpickled(pickled: tuple[Any, ...], path: str, arguments: tuple[Any, ...]) -> Any:
    """Create a pickled value again, by this build, and return it; pickle calls this function.

    A build is a compiled package. pickled: fields of the `Identity` of the build that pickled the
    value. path, arguments: as in `call_path`, which creates the value. If this build cannot read
    the value, return an `Unreadable` placeholder.
    """
    if why := refusal(pickled, path):
        return Unreadable(why, RuntimeError, (unpickled, (pickled, path, arguments)))
    return call_path(path, arguments)


def refusal(pickled: tuple[Any, ...], path: str) -> str:
    """Return the reason why this build cannot read a value of another build; "" if it can.

    A build is a compiled package. Compiled code that another build has pickled is refused. Data of
    another build are read, with a warning, if their columns have the same names in the same order
    and their number type is the same. pickled: fields of the other build's `Identity`. path: what
    is called to create the value again, as in `call_path`.
    """
    if path.startswith("status."):  # errors have a text alone
        return ""
    own, other = Identity(*identity()), Identity(*pickled)
    if own[:2] == other[:2]:
        return ""
    name = own_model().info.name
    if path in (MODULE, MODEL, COMPONENT):
        return (
            f"{name}: this was pickled by the build {other.extension}, which is gone; the build "
            f"here is {own.extension}: load the scene again and pickle its module"
        )
    for what in ("coordinates", "parameters", "inputs", "events"):
        if getattr(own, what) != getattr(other, what):
            return (
                f"{name}: this was pickled by another version of the scene, whose {what} were "
                f"{', '.join(getattr(other, what)) or 'none'}; here they are "
                f"{', '.join(getattr(own, what)) or 'none'}"
            )
    if own.dtype != other.dtype:
        return f"{name}: this was pickled in {other.dtype}; the build here has {own.dtype}"
    try:
        _located(path)
    except (AttributeError, ModuleNotFoundError):
        return (
            f"{name}: this was pickled by an earlier version of eomc, whose build is gone: "
            "simulate again, or load a file that run.save wrote"
        )
    warn(
        f"{name}: this was pickled by another build of the scene, which is gone; what is computed "
        "from it now is of the present version"
    )
    return ""


class Unreadable:
    """Placeholder for a pickled value whose build does not exist: any use of it raises an error.

    The error is not raised when the pickle is read, since a process pool would then wait forever.
    Attributes of the placeholder are placeholders as well.
    """

    _why: str
    _error: type[Exception]
    _again: tuple[Any, ...]

    def __init__(self, why: str, error: type[Exception], again: tuple[Any, ...]) -> None:
        self.__dict__.update(_why=why, _error=error, _again=again)

    def __getattr__(self, name: str) -> Unreadable:
        if name.startswith("_"):
            raise AttributeError(name)
        return Unreadable(self._why, self._error, (getattr, (self, name)))

    def __repr__(self) -> str:
        return f"<unreadable: {self._why}>"

    def __reduce__(self) -> tuple[Any, ...]:
        return self._again

    def _refused(self, *_: Any, **__: Any) -> NoReturn:
        raise self._error(self._why)

    __call__ = __getitem__ = __setitem__ = __iter__ = __len__ = __contains__ = _refused
    __bool__ = __int__ = __float__ = __index__ = __complex__ = __array__ = __setattr__ = _refused
    __eq__ = __ne__ = __lt__ = __le__ = __gt__ = __ge__ = _refused
    __add__ = __radd__ = __sub__ = __rsub__ = __mul__ = __rmul__ = __matmul__ = _refused
    __truediv__ = __rtruediv__ = __neg__ = __pow__ = __enter__ = __exit__ = _refused
    __hash__ = object.__hash__


_ONLY_OF_SCENES = ("frames", "momentum")  # options that concern bodies
# of [run], as System.make has it
_SPELLED = {"true": "True", "method": "methods", '"stick"': "{...}"}


def option(key: str, value: str = "true") -> str:
    """Return, as text for a message, the option with which the user builds a feature into a module.

    For a scene, the option is a key of [run], such as "[run] linearize = true". For a System, it is
    an argument of System.make. key: name of the option. value: its value in TOML.
    """
    if not is_built_from_system():
        return f"[run] {key} = {value}"
    if key in _ONLY_OF_SCENES:
        return f"[run] {key} = {value} of a scene with bodies, which System.make has not"
    return f"System.make(..., {_SPELLED.get(key, key)}={_SPELLED.get(value, value)})"


def named_outputs() -> str:
    """Return text for a message: where in the scene or System the user names the outputs."""
    where = "System.make(..., outputs={...})" if is_built_from_system() else "[outputs]"
    return f"name them in {where}"


def is_built_from_system() -> bool:
    """Return True if this package was built from a `System` of Python, not from a scene in TOML."""
    package = import_module(_BUILT)
    return bool(getattr(package, "_from_python", False))


def suggestion(name: str, known: Iterable[str]) -> str:
    """Return text such as "; did you mean 'm_c'?" for an unknown name that a user gave.

    known: the allowed names. Return "" if none of them is similar to `name`.
    """
    import difflib  # of use here alone

    known = [*known]
    near = [k for k in known if k.lower() == str(name).lower()]
    near = near or difflib.get_close_matches(str(name), known, n=1)
    return f"; did you mean '{near[0]}'?" if near else ""


def initial_value_message(model: Any, name: str) -> str:
    """Return a message that `name` is a coordinate, not a parameter, with a remedy.

    The remedy says in which argument the value of the coordinate is given.
    """
    if name in model.info.discrete_coordinates:
        return (
            f"a jump sets '{name}', so it is a state behind the coordinates, not a parameter: give "
            f"it in q0, [{', '.join(model.info.coordinates)}], or eomc run --start {name}=..."
        )
    return f"'{name}' is a coordinate: give it in q0"


# common names of other packages for the arguments of a run
_CALLED = {
    "dt": "h", "step": "h", "step_size": "h", "stepsize": "h", "timestep": "h", "rtol": "tol",
    "atol": "tol", "tolerance": "tol", "eps": "tol", "h_most": "max_step", "h_max": "max_step",
    "t_eval": "times", "tmax": "duration", "t": "duration", "t_end": "duration",
    "t_final": "duration", "t_span": "duration", "x0": "q0", "v0": "qd0",
}  # fmt: skip


def no_argument(model: Any, call: Callable[..., Any], unknown: Mapping[str, Any]) -> TypeError:
    """Return the TypeError for an unknown argument of a function, with a suggestion.

    call: the function. unknown: the unknown arguments by name, of which the first is reported.
    """
    from inspect import signature  # of use here alone

    name, known = next(iter(unknown)), [*signature(call).parameters][:-1]  # all but **unknown
    table = "params" if name in model.info.parameters else "u" if name in model.info.inputs else ""
    near = (
        f": write {table}={{'{name}': ...}}"
        if table
        else suggestion(_CALLED.get(name, name), known)
    )
    if name in model.info.coordinates:
        near = f": {initial_value_message(model, name)}"
    near = near or f": it has {', '.join(known)}"
    return TypeError(f"{call.__name__} has no argument '{name}'{near}")


def warn(words: str) -> None:
    """Issue a RuntimeWarning with the text `words`.

    The warning points to the line of the user's code that called a function of eomc or of a built
    package.
    """
    level, frame = 2, sys._getframe(1)
    while frame.f_back is not None and _of_eomc(str(frame.f_globals.get("__package__"))):
        level, frame = level + 1, frame.f_back
    warnings.warn(words, RuntimeWarning, stacklevel=level)


def _of_eomc(package: str) -> bool:
    """Return True if the package is a built one, or eomc itself."""
    whole = sys.modules.get(package.removesuffix("._runtime"))
    return package.split(".")[0] == "eomc" or (
        type(whole).__name__ == Package.__name__ and "_model" in vars(whole)
    )


def require_eomc(module: str, what: str = "runs are drawn") -> Any:
    """Import and return the module `eomc.<module>` of the installed package eomc.

    A built package needs eomc only for pictures and for events that the scene does not define.
    what: the purpose, as the beginning of the error message. Raises ImportError, with a remedy, if
    eomc is not installed.
    """
    try:
        return import_module(f"eomc.{module}")
    except ModuleNotFoundError as fault:
        if not str(fault.name).startswith("eomc"):
            raise
        raise ImportError(
            f"{what} by eomc, which is not here: in its clone 'pip install .' "
            "installs it, elsewhere 'pip install' with the file of its wheel"
        ) from None


def with_events(call: Callable[..., Any], arguments: dict[str, Any]) -> Any:
    """Return the model extended by a call's additional events, and the other arguments of the call.

    call: the method that the user called. arguments: all its local variables, including "self" (a
    `Component`), "events" and "unknown" (arguments that the method does not have). Raises TypeError
    for unknown arguments.

    A parameter that a jump of an additional event sets is a state of the extended model, not a
    parameter. Therefore only the parameters that differ from the scene's values are passed on.
    """
    part, events, unknown = (arguments.pop(name) for name in ("self", "events", "unknown"))
    model = part.model
    if unknown:
        raise no_argument(model, call, unknown)
    other = eventful(model, events)
    if hasattr(params := arguments["params"], "_names"):
        values = {name: getattr(params, name) for name in params._names}
        arguments["params"] = {k: x for k, x in values.items() if x != model.info.defaults[k]}
    return other, arguments


def eventful(model: Any, events: Any) -> Any:
    """Return the model extended by additional events.

    events: mapping of the events by name, each a formula or a table such as [[event]] of a scene.
    The extended model is compiled at the first call and reused afterwards.
    """
    known = model.extensions
    if (key := repr(events)) not in known:
        build = require_eomc("pipeline", "events of a run are compiled").with_events
        known[key] = model_of(build(model, events, Path(__file__).parents[1]))
        known[key].extension_of = model, events  # for files of its runs
    return known[key]


# functions and other attributes of scenes with constraints only
CONSTRAINED = "constraint_jacobian constraint_rates constraints multipliers project tangent".split()
_CONSTRAINED = (*CONSTRAINED, "constraint_names", "loops", "reactions")


class Package(ModuleType):
    """Class of a built package (a Python module of a compiled scene).

    It explains missing names in error messages and refuses assignments.
    """

    def __getattr__(self, name: str) -> Any:
        """Raise AttributeError; for names that exist only with constraints, the message says so."""
        model = self.__dict__.get("_model")
        if model is not None and name in _CONSTRAINED:
            there = "a scene has them by [constraints] or [[loop]]"
            if is_built_from_system():
                there = "give them by System.make(..., constraints={...})"
            closed = model.info.constraints.names
            what = "[[loop]]" if closed else f"constraints: {there}"
            raise AttributeError(f"{name}: {model.info.name} has no {what}")
        own = self.__dict__.get("__getattr__", super().__getattribute__)
        return own(name)

    def __setattr__(self, name: str, value: Any) -> None:
        if not name.startswith("_") and (why := self._why_not(name, value)):
            raise AttributeError(f"{name}: {why}")
        super().__setattr__(name, value)

    def _why_not(self, name: str, value: Any) -> str:
        """Return the reason why a name cannot be assigned, with a remedy; "" if it can."""
        info = self.__dict__["_model"].info
        call = f"{info.name}.simulate"
        if name in info.parameters:
            return (
                "a parameter is given to a call, not assigned to the module: "
                f'{call}(params={{"{name}": {value!r}}}), or eomc run --set {name}={value!r}; '
                "its default is in the scene"
            )
        if name in ("h", "duration"):
            return f"is given to a call, {call}({name}={value!r}), or eomc run --{name} {value!r}"
        if name in info.inputs:
            return f'an input is given to a call: {call}(u={{"{name}": {value!r}}})'
        rates = [f"{c}_dot" for c in info.coordinates]
        if name in (*info.coordinates, *rates, "start"):
            return f"a start is given to a call: {call}(q0=..., qd0=...), or eomc run --start"
        if name in self.__all__:
            return "belongs to the module and stays as it is"
        near = suggestion(name, (*info.parameters, *info.inputs, *info.coordinates, *rates))
        if not near or isinstance(value, ModuleType):  # one of its own files, imported
            return ""
        return f"is no name of the scene{near}; values are given to a call: {call}(params={{...}})"

    def __dir__(self) -> list[str]:
        """Return the public names of the module, without its submodules."""
        names = vars(self)
        return sorted({*names.get("__all__", names), *(n for n in names if n.startswith("__"))})

    def __repr__(self) -> str:
        model = self.__dict__.get("_model")
        if model is None:  # not imported yet
            return super().__repr__()
        counts = {
            "coordinate": model.info.nq,
            "input": model.info.nu,
            "parameter": len(model.info.parameters),
        }
        summary = ", ".join(f"{n} {what}{'s' * (n != 1)}" for what, n in counts.items())
        return f"<compiled scene {model.info.name}: {summary}>"

    def __reduce__(self) -> tuple[Any, ...]:
        return reduced(MODULE)

    def _self(self) -> Package:
        return self


class Defaults(dict[str, float]):
    """The scene's parameter values by name.

    Assignments raise TypeError, since the C code would not see a change.
    """

    def _refused(self, *_: Any, **__: Any) -> NoReturn:
        raise TypeError(
            "defaults are the scene's and stay: give params={...} to a call, or eomc run --set"
        )

    __setitem__ = __delitem__ = __ior__ = _refused
    update = setdefault = pop = popitem = clear = _refused

    def __reduce__(self) -> tuple[Any, ...]:
        return dict, (dict(self),)
