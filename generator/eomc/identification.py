"""Parameter estimation: `eomc.fit` estimates parameters and initial values from measured columns.

The method is that of output errors (nonlinear least squares of simulated minus measured outputs)
with SciPy's `least_squares` and the exact sensitivities of the steps.

References
----------
R. V. Jategaonkar, Flight Vehicle System Identification, 2nd ed., AIAA, 2015, ch. 4.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from eomc import pipeline
from eomc.base import texts
from eomc.base.errors import EomcError, writing
from eomc.runtime.atomic_write import atomic_write
from eomc.runtime.package import model_of
from eomc.runtime.requests import initial_state_for_parameters
from eomc.runtime.sensitivity import Sensitivity, output_sensitivity

if TYPE_CHECKING:
    from eomc.model.system import System

Array = np.ndarray[Any, np.dtype[Any]]

TOLERANCE = 1e-9  # of SciPy's iteration, relative changes of the cost and of the values
MAX_REWEIGHTINGS = 4  # iterations over the noise of the columns
# smallest singular value, of a Jacobian with columns of length 1, at which values are identifiable
RANK_TOLERANCE = 1e-6
# effect of a change by its whole value on the columns, relative to them, below which it is rounding
EFFECT_TOLERANCE = 1e-9


@dataclass(frozen=True, eq=False)
class Fit:
    """Estimated parameters and initial values.

    Attributes
    ----------
    values, standard_errors : dict of float
        Estimates by name, and their standard errors; nan if a value is not identifiable.
    correlation : (k, k) array
        Correlation of the estimates, in the order of `values`.
    without_effect : tuple of str
        Names of values on which no measured column depends.
    ambiguous : tuple of str
        Names of values of which only combinations affect the measured columns.
    t : (n,) array
        Times of the rows, s; those of several logs follow one another.
    starts : tuple of int
        Index of the first row of each log.
    measured, fitted : dict of (n,) arrays
        Measured columns by name, nan where a value is missing, and the columns of the model.
    ignored : tuple of str
        Names of columns that the model does not have.
    rms : dict of float
        Root mean square of the residuals of each measured column.
    success : bool
        True if the iteration converged.
    message : str
        The reason why the iteration ended.
    evaluations : int
        Number of simulations.
    units : dict of str
        Units by name.
    title : str
        Title of the scene.
    """

    values: dict[str, float]
    standard_errors: dict[str, float]
    correlation: Array
    without_effect: tuple[str, ...]
    ambiguous: tuple[str, ...]
    t: Array
    starts: tuple[int, ...]
    measured: dict[str, Array]
    fitted: dict[str, Array]
    ignored: tuple[str, ...]
    rms: dict[str, float]
    success: bool
    message: str
    evaluations: int
    units: dict[str, str]
    title: str

    @property
    def residuals(self) -> dict[str, Array]:
        """Fitted minus measured columns by name, (n,), nan where a value is missing."""
        return {name: self.fitted[name] - y for name, y in self.measured.items()}

    @property
    def warnings(self) -> tuple[str, ...]:
        """Sentences about values that are not identifiable, and about a failed iteration."""
        remedy = "fix it, or measure a quantity that depends on it"
        lines = [
            f"'{name}' is not identifiable: no measured column depends on it: {remedy}"
            for name in self.without_effect
        ]
        if self.ambiguous:
            lines.append(
                f"{texts.listed([*self.ambiguous])} are not identifiable: the measured columns "
                "depend on combinations of them only: fix one of them, or measure another quantity"
            )
        return (*lines, *([] if self.success else [f"no convergence: {self.message}"]))

    def __str__(self) -> str:
        rows = sum(int(np.isfinite(y).sum()) for y in self.measured.values())
        lines = [
            f"{self.title}: {len(self.values)} values from {rows} measured values of "
            f"{texts.listed([*self.measured])}, {self.evaluations} simulations"
        ]
        wide = max(map(len, [*self.values, *self.measured]))
        for name, value in self.values.items():
            error, unit = self.standard_errors[name], self.units.get(name.partition("[")[0], "")
            of = f" ± {error:.2g}" if math.isfinite(error) else ""
            lines.append(f"  {name:{wide}} {value: .9g}{of} {unit}".rstrip())
        if len(self.values) > 1:
            lines.append("  correlation:")
            for k, name in enumerate(self.values):
                row = (
                    f"{x: .3f}" if math.isfinite(x) else "     -" for x in self.correlation[k, :k]
                )
                lines.append(f"  {name:{wide}} {' '.join(row)}".rstrip())
        lines.append("  residuals, root mean square:")
        lines += [
            f"  {name:{wide}} {x: .3g} {self.units.get(name, '')}".rstrip()
            for name, x in self.rms.items()
        ]
        if self.ignored:
            lines.append(f"  ignored columns: {texts.listed([*self.ignored])}")
        return texts.lines("\n".join([*lines, *(f"  {words}" for words in self.warnings)]))

    def write_plot(self, path: str | Path) -> None:
        """Draw the measured and the fitted columns, and write the figure: .png, .svg or .pdf.

        Raises EomcError if matplotlib is not installed, or the file can't be written.
        """
        from eomc.report.plot import FAINT, SUFFIXES, choose_colours

        path = Path(path)
        if path.suffix not in SUFFIXES:
            raise EomcError(f"{path}: a picture is written as {', '.join(SUFFIXES)}")
        try:
            import matplotlib.figure
        except ImportError:
            raise EomcError("drawing needs matplotlib: pip install matplotlib") from None
        with matplotlib.rc_context({"text.usetex": False}):
            count = len(self.measured)
            figure = matplotlib.figure.Figure((9, 1.5 + 2.2 * count), layout="constrained")
            grid = figure.subplots(count, 1, sharex=True, squeeze=False)[:, 0]
            (colour,) = choose_colours(1)
            for axes, (name, y) in zip(grid, self.measured.items(), strict=True):
                axes.plot(self.t, y, ".", color="#999999", markersize=3, label="measured")
                ends = (*self.starts[1:], len(self.t))
                for first, end in zip(self.starts, ends, strict=True):
                    label = "" if first else "fitted"
                    line = self.t[first:end], self.fitted[name][first:end]
                    axes.plot(*line, color=colour, label=label)
                unit = self.units.get(name, "")
                axes.set_ylabel(texts.figure(f"{name} ({unit})" if unit else name))
                axes.grid(color=FAINT)
            grid[0].set_title(texts.figure(self.title))
            grid[0].legend()
            grid[-1].set_xlabel("t (s)")
            with writing(path), atomic_write(path) as new:
                figure.savefig(new, format=path.suffix[1:], dpi=150)


def fit(
    scene: Any, log: Any, *, free: Sequence[str] | None = None,
    values: Mapping[str, float] | None = None,
    bounds: Mapping[str, tuple[float, float]] | None = None, h: float | None = None,
    root: str | Path = "build",
) -> Fit:  # fmt: skip
    """Estimate parameters and initial values of a scene from logs of measured columns.

    The sum of squared residuals, simulated minus measured, is minimised. Columns are weighted by
    the inverse of their noise, which is estimated from their residuals.

    Parameters
    ----------
    scene : path or System
        Scene. It needs no `linearize` and `discretize`, which are added.
    log : path, mapping, or a list of these
        A CSV file whose first line has the names of the columns, or the columns by name. `t`, s, is
        required. Measured columns have the names of coordinates, velocities (`theta_dot`) or
        outputs; empty cells and nan are missing values. Columns of inputs are constant from each
        row to the next; without such columns the inputs follow the scene's signals. Several logs
        are experiments with the same parameters; each has its own initial values.
    free : sequence of str, optional
        Names of the estimated values: parameters, and coordinates or velocities, whose initial
        values are then estimated. By default all parameters. With several logs the initial values
        of `theta` are `theta[1]`, `theta[2]`, ... in the result and in `bounds`.
    values : mapping, optional
        Parameters and initial coordinates and velocities by name, in place of those of the scene:
        initial guesses of free ones. Without it the guess of a free initial coordinate or velocity
        is its first measured value. `theta[2]` is that of the second log only.
    bounds : mapping, optional
        (low, high) of free values by name.
    h : float, optional
        Largest step size of the scene's first method, s; by default that of the scene.
    root : path
        Folder of built modules.

    Returns
    -------
    Fit

    Raises
    ------
    EomcError
        If SciPy is not installed, or an argument or the log is invalid.
    SceneError
        If the scene is invalid, or has no derivatives.
    """
    try:
        from scipy.optimize import least_squares
    except ImportError:
        raise EomcError("fit needs SciPy: pip install scipy") from None
    arguments = FitArguments(scene, free, values or {}, bounds or {}, h, root)
    problem = arguments.prepare(log)
    low, high = problem.check_bounds(arguments.bounds)
    estimates = np.clip(problem.guess, low, high)
    deviations = {name: _deviation(y) for name, y in problem.measured.items()}
    for _ in range(MAX_REWEIGHTINGS if len(deviations) > 1 else 1):
        weighted = Residuals(problem, deviations)
        if not np.isfinite(weighted(estimates)).all():
            raise EomcError(
                f"fit: the simulation with the initial guesses fails: {problem.failure}: give "
                "other values, or a smaller h"
            )
        solution = least_squares(
            weighted, estimates, weighted.jacobian, (low, high), x_scale="jac",
            ftol=TOLERANCE, xtol=TOLERANCE, gtol=TOLERANCE,
        )  # fmt: skip
        change, estimates = np.abs(solution.x - estimates), solution.x
        fitted, rms = problem.residual_sizes(estimates)
        deviations = {n: max(x, 1e-9 * _deviation(problem.measured[n])) for n, x in rms.items()}
        if (change <= TOLERANCE * np.abs(estimates)).all():
            break
    errors, correlation, without_effect, ambiguous = Residuals(problem, deviations).statistics(
        estimates
    )
    return Fit(
        dict(zip(problem.free, estimates.tolist(), strict=True)),
        dict(zip(problem.free, errors.tolist(), strict=True)),
        correlation, without_effect, ambiguous, problem.t, problem.starts, problem.measured, fitted,
        problem.ignored, rms, bool(solution.success), solution.message, problem.evaluations,
        problem.units, problem.system.title or problem.system.name,
    )  # fmt: skip


def read_log(log: Any) -> dict[str, Array]:
    """Return the columns of a log by name. log: path of a CSV file, or a mapping of columns.

    Raises EomcError if the file can't be read, or a cell is not a number.
    """
    if isinstance(log, Mapping):
        try:
            return {str(name): np.array(x, float) for name, x in log.items()}
        except (TypeError, ValueError):
            raise EomcError("log: expected columns of numbers by name") from None
    path = Path(log)
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            lines = [line for line in csv.reader(file) if line and not line[0].startswith("#")]
    except (OSError, UnicodeDecodeError, csv.Error) as fault:
        raise EomcError(f"{path}: can't be read ({fault})") from None
    if len(lines) < 2:
        raise EomcError(f"{path}: expected a line with the names of the columns, then rows")
    header = [name.strip() for name in lines[0]]
    if twice := [name for k, name in enumerate(header) if name in header[:k]]:
        raise EomcError(f"{path}: two columns are named '{twice[0]}'")
    table = np.empty((len(lines) - 1, len(header)))
    for k, line in enumerate(lines[1:]):
        if len(line) != len(header):
            raise EomcError(f"{path}: row {k + 1} has {len(line)} cells for {len(header)} names")
        for i, cell in enumerate(line):
            try:
                table[k, i] = float(cell) if cell.strip() else math.nan
            except ValueError:
                raise EomcError(
                    f"{path}: row {k + 1}, column {header[i]}: '{cell}' is not a number"
                ) from None
    return dict(zip(header, table.T.copy(), strict=True))


def read_logs(log: Any) -> tuple[dict[str, Array], tuple[int, ...]]:
    """Return the columns of one log or several, one after another, and the first row of each log.

    Values of a column that a log does not have are nan. Raises EomcError if a log is invalid.
    """
    logs = [read_log(one) for one in (log if isinstance(log, (list, tuple)) else [log])]
    for k, columns in enumerate(logs):
        name = f"log {k + 1}" if len(logs) > 1 else "the log"
        if "t" not in columns:
            raise EomcError(f"fit: {name} has no column t, but {texts.listed([*columns])}")
        t = columns["t"]
        if any(x.shape != t.shape for x in columns.values()) or t.ndim != 1:
            raise EomcError(f"fit: the columns of {name} have different lengths")
        if not (np.isfinite(t).all() and (np.diff(t) > 0).all() and len(t) > 1):
            raise EomcError(f"fit: t of {name} must be finite and ascending, two rows at least")
    if not logs:
        raise EomcError("fit: give a log")
    names = dict.fromkeys(name for columns in logs for name in columns)
    rows = [len(columns["t"]) for columns in logs]
    parts = {
        name: [columns.get(name, np.full(n, np.nan)) for columns, n in zip(logs, rows, strict=True)]
        for name in names
    }
    merged = {name: np.concatenate(columns) for name, columns in parts.items()}
    return merged, tuple(np.cumsum([0, *rows[:-1]]).tolist())


def _deviation(y: Array) -> float:
    """Return the standard deviation of the values of a column, or 1 if they are equal."""
    return float(np.nanstd(y)) or 1.0


@dataclass(frozen=True)
class FitArguments:
    """The arguments of `fit` other than the log, which describes them."""

    scene: Any
    free: Sequence[str] | None
    values: Mapping[str, float]
    bounds: Mapping[str, tuple[float, float]]
    h: float | None
    root: str | Path

    def prepare(self, log: Any) -> Estimation:
        """Check the arguments, and build the module with the derivatives that `fit` needs."""
        columns, starts = read_logs(log)
        tags = [f"[{k + 1}]" for k in range(len(starts))] if len(starts) > 1 else [""]
        scene = self.scene
        system: System = scene if hasattr(scene, "coordinates") else pipeline.read(scene)
        if jumps := [e.name for e in system.events if e.jump]:
            raise EomcError(
                f"fit: the state jumps at the event '{jumps[0]}', and sensitivities through jumps "
                "are not available: remove the event, and use rows before the first jump"
            )
        run = replace(system.run, linearize="parameters", discretize=True, real="double")
        module: Any = pipeline.load(replace(system, run=run), Path(self.root) / ".fit")
        info = model_of(module).info
        known = (*info.parameters, *info.states)
        own_starts = [f"{name}{tag}" for name in info.states for tag in tags]
        _check_names("values", self.values, (*known, *own_starts))
        names = tuple(info.parameters if self.free is None else self.free)
        _check_names("free", names, known)
        if not names:
            raise EomcError(f"fit: {info.name} has no parameters: give free=, names of coordinates")
        if len(set(names)) < len(names):
            raise EomcError("fit: free: a name is given twice")
        if self.h is not None and not (math.isfinite(self.h) and self.h > 0):
            raise EomcError(f"fit: h = {self.h} is not a step size in s")
        free = [f"{n}{tag}" for n in names for tag in (tags if n in info.states else [""])]
        own = {name: x for name, x in self.values.items() if name in info.parameters}
        params = {**module.defaults, **own}
        start = {name: x for name, x in self.values.items() if name not in own}
        logs = [
            Log(slice(first, end), tag)
            for first, end, tag in zip(starts, (*starts[1:], None), tags, strict=True)
        ]
        return Estimation(
            system, module, columns, logs, tuple(free), params, start, self.h or info.h
        )


def _check_names(what: str, names: Iterable[str], known: Sequence[str]) -> None:
    """Raise EomcError for the first name that is not known. what: name of the argument."""
    from eomc.scene.formulas import suggest

    for name in names:
        if name not in known:
            remedy = suggest(name, known) or f": there are {texts.listed([*known])}"
            raise EomcError(f"fit: {what}: '{name}' is not a value of the scene{remedy}")


@dataclass(frozen=True)
class Log:
    """The rows of one log, and the end of the names of its initial values, such as "[2]"."""

    rows: slice
    tag: str

    def names(self, names: Iterable[str]) -> list[str]:
        """Return names without the tag of this log, and "" for initial values of other logs."""
        return ["" if "[" in (n := name.removesuffix(self.tag)) else n for name in names]

    def select(self, start: Mapping[str, float]) -> dict[str, float]:
        """Return the initial values of this log; those with its tag replace those of all logs."""
        ordered = sorted(start, key=lambda name: "[" in name)
        named = zip(self.names(ordered), ordered, strict=True)
        return {name: start[full] for name, full in named if name}


@dataclass(eq=False)
class Estimation:
    """A scene, the rows of logs, and the values to be estimated.

    columns: those of the logs by name. free: names of the estimated values. params, start: fixed
    values and initial guesses by name. h: step size of the simulations, s.
    """

    system: System
    module: Any
    columns: dict[str, Array]
    logs: list[Log]
    free: tuple[str, ...]
    params: dict[str, float]
    start: dict[str, float]
    h: float
    evaluations: int = 0
    failure: str = ""

    def __post_init__(self) -> None:
        info, columns = self.info, self.columns
        self.t = columns["t"]
        self.starts = tuple(log.rows.start for log in self.logs)
        measurable = (*info.states, *info.outputs)
        self.measured = {name: x for name, x in columns.items() if name in measurable}
        known = {"t", *measurable, *info.inputs}
        self.ignored = tuple(name for name in columns if name not in known)
        if not any(np.isfinite(x).any() for x in self.measured.values()):
            raise EomcError(
                f"fit: the log has no measured column: its columns are {texts.listed([*columns])}, "
                f"and the scene has {texts.listed([*measurable])}"
            )
        self.u = self._inputs()
        low = sum(int(np.isfinite(x).sum()) for x in self.measured.values())
        if low < len(self.free):
            raise EomcError(f"fit: {low} measured values are too few for {len(self.free)} unknowns")

    @property
    def info(self) -> Any:
        """The constant data of the module."""
        return model_of(self.module).info

    def _inputs(self) -> Array | None:
        """Return the inputs of each row, (n, nu); None: the scene's signals."""
        inputs = self.info.inputs
        missing = [name for name in inputs if name not in self.columns]
        if len(missing) == len(inputs):
            return None
        if missing:
            raise EomcError(
                f"fit: the log has columns of some inputs, but not of {texts.listed(missing)}: add "
                "them, or leave out all inputs, which then follow the scene's signals"
            )
        u = np.stack([self.columns[name] for name in inputs], axis=-1)
        if not np.isfinite(u).all():
            name = inputs[int(np.argwhere(~np.isfinite(u))[0, 1])]
            raise EomcError(f"fit: a value of the input {name} is missing in the log")
        return u

    @property
    def units(self) -> dict[str, str]:
        """Units by name."""
        units = dict(self.module.units)
        rates = {f"{n}_dot": f"{units[n]}/s" for n in self.info.coordinates if units.get(n)}
        return rates | units

    @cached_property
    def guess(self) -> Array:
        """Initial guesses of the free values: given ones, measured ones, those of the scene."""
        guesses: dict[str, float] = {}
        for log in self.logs:
            first = {n: x[log.rows.start] for n, x in self.measured.items()}
            first = {n: x for n, x in first.items() if np.isfinite(x)}
            states = np.ravel(self._state(self.params, {}))
            own = dict(zip(self.info.states, states, strict=True))
            known = {**own, **first, **log.select(self.start), **self.params}
            named = zip(self.free, log.names(self.free), strict=True)
            guesses |= {full: known[name] for full, name in named if name}
        return np.array([guesses[name] for name in self.free])

    def check_bounds(self, bounds: Mapping[str, tuple[float, float]]) -> tuple[Array, Array]:
        """Return the lower and upper bounds of the free values. Raises EomcError."""
        _check_names("bounds", bounds, self.free)
        pairs = np.array([bounds.get(name, (-np.inf, np.inf)) for name in self.free], float)
        for name, (low, high) in zip(self.free, pairs, strict=True):
            if not low < high:
                raise EomcError(f"fit: bounds of {name}: {low:g} is not less than {high:g}")
        return pairs[:, 0], pairs[:, 1]

    def _state(
        self, params: Mapping[str, float], start: Mapping[str, float]
    ) -> tuple[Array, Array]:
        """Return the initial state; `start` replaces values of the scene."""
        model, names = model_of(self.module), self.info.coordinates
        halves = [{n: start[f"{n}{end}"] for n in names if f"{n}{end}" in start}
                  for end in ("", "_dot")]  # fmt: skip
        q, qd = initial_state_for_parameters(
            model, halves[0], halves[1], model.arguments.parameters(dict(params))
        )
        return np.array(q, float), np.array(qd, float)

    def _directions(
        self, params: Mapping[str, float], start: Mapping[str, float], free: Sequence[str]
    ) -> tuple[Array, Array]:
        """Return d[q0; qd0]/dv (2 nq, k) and dp/dv (np, k) of the k free values v of a log."""
        from sympy import Symbol

        from eomc.model.algebra import ALGEBRA
        from eomc.scene import formulas

        states, names = self.info.states, self.info.parameters
        by_start = (np.array(states)[:, None] == free).astype(float)
        constant = {*start, *free}
        symbols = {name: Symbol(name, real=True) for name in names}
        at = {symbols[name]: value for name, value in params.items()}
        for name, text in self.info.start_formulas.items():
            if name not in constant:
                formula = formulas.evaluate(formulas.parse(text), ALGEBRA, symbols.__getitem__)
                by_start[states.index(name)] = [
                    float(formula.diff(symbols[v]).subs(at)) if v in symbols else 0.0 for v in free
                ]
        return by_start, (np.array(names)[:, None] == free).astype(float)

    def simulate(self, values: Array) -> tuple[dict[str, Array], dict[str, Array]]:
        """Return the measured columns of the model, and their derivatives by the free values.

        Raises MotionError if a step fails.
        """
        self.evaluations += 1
        columns, derivatives = zip(*(self._simulate_log(x, values) for x in self.logs), strict=True)
        return (
            {name: np.concatenate([x[name] for x in columns]) for name in self.measured},
            {name: np.concatenate([x[name] for x in derivatives]) for name in self.measured},
        )

    def _simulate_log(self, log: Log, values: Array) -> tuple[dict[str, Array], dict[str, Array]]:
        model, free = model_of(self.module), log.names(self.free)
        by_name = {n: x for n, x in zip(free, values.tolist(), strict=True) if n}
        params = self.params | {k: v for k, v in by_name.items() if k in self.params}
        start = log.select(self.start)
        start |= {k: v for k, v in by_name.items() if k not in self.params}
        t, u = self.t[log.rows], None if self.u is None else self.u[log.rows]
        p = model.arguments.parameters(params)
        q, qd = np.empty((2, len(t), self.info.nq))
        q[0], qd[0] = self._state(params, start)
        states = Sensitivity(*model.integrator.propagate(
            (q, qd), t, u, p, self.h, self.info.methods[0], has_rows=False
        ))  # fmt: skip
        by_start, by_p = self._directions(params, start, free)
        columns = dict(zip(self.info.states, np.hstack([q, qd]).T, strict=True))
        slopes = states.start @ by_start + states.parameters @ by_p
        derivatives = dict(zip(self.info.states, slopes.swapaxes(0, 1), strict=True))
        if self.measured.keys() & {*self.info.outputs}:
            y = model.functions.output(q, qd, t, u, p)
            columns |= dict(zip(self.info.outputs, y.T, strict=True))
            of = output_sensitivity(model, states, (q, qd), t, u, p)
            slopes = of.start @ by_start + of.parameters @ by_p
            derivatives |= dict(zip(self.info.outputs, slopes.swapaxes(0, 1), strict=True))
        return columns, derivatives

    def residual_sizes(self, values: Array) -> tuple[dict[str, Array], dict[str, float]]:
        """Return the measured columns of the model, and the RMS of the residuals of each."""
        fitted, _ = self.simulate(values)
        squares = {n: np.nanmean((fitted[n] - y) ** 2) for n, y in self.measured.items()}
        return fitted, {name: float(np.sqrt(x)) for name, x in squares.items()}


class Residuals:
    """Weighted residuals of the measured values and their Jacobian, as SciPy calls them.

    deviations: standard deviation of the noise of each column by name.
    """

    def __init__(self, problem: Estimation, deviations: Mapping[str, float]) -> None:
        self.problem, self.deviations = problem, deviations
        self.last: tuple[Array, Array, Array] | None = None  # values, residuals, Jacobian

    def __call__(self, values: Array) -> Array:
        """Return the weighted residuals, (m,); inf if the simulation fails."""
        return self._evaluate(values)[0]

    def jacobian(self, values: Array) -> Array:
        """Return the derivatives of the residuals, (m, k), with zeros for rounding errors."""
        return self._evaluate(values)[1] * self._have_effect(values)

    def _have_effect(self, values: Array) -> Array:
        """Return for each value whether it affects the measured columns by more than rounding."""
        J, columns = self._evaluate(values)[1], self.problem.measured.items()
        size = math.hypot(*(float(np.linalg.norm(y[np.isfinite(y)])) / self.deviations[name]
                            for name, y in columns))  # fmt: skip
        sizes = np.linalg.norm(J, axis=0) * np.where(values == 0, 1.0, np.abs(values))
        return np.asarray(sizes > EFFECT_TOLERANCE * size)

    def _evaluate(self, values: Array) -> tuple[Array, Array]:
        if self.last is None or not np.array_equal(self.last[0], values):
            problem = self.problem
            try:
                columns, derivatives = problem.simulate(values)
            except problem.module.MotionError as fault:  # SciPy then takes a shorter step
                problem.failure = str(fault)
                count = sum(int(np.isfinite(y).sum()) for y in problem.measured.values())
                return np.full(count, np.inf), np.zeros((count, len(values)))
            residuals, slopes = [], []
            for name, y in problem.measured.items():
                rows = np.isfinite(y)
                residuals.append((columns[name] - y)[rows] / self.deviations[name])
                slopes.append(derivatives[name][rows] / self.deviations[name])
            self.last = values.copy(), np.concatenate(residuals), np.concatenate(slopes)
        return self.last[1], self.last[2]

    def statistics(self, values: Array) -> tuple[Array, Array, tuple[str, ...], tuple[str, ...]]:
        """Return standard errors (k,), correlation (k, k), and names that are not identifiable.

        The names are of values without effect, and of those of which only combinations have one.
        """
        residuals, J = self._evaluate(values)
        names, count = np.array(self.problem.free), len(values)
        lengths, effect = np.linalg.norm(J, axis=0), self._have_effect(values)
        _, s, V = np.linalg.svd(J[:, effect] / lengths[effect], full_matrices=False)
        regular = s > RANK_TOLERANCE * np.max(s, initial=0)
        mixed = np.linalg.norm(V[~regular], axis=0) > np.sqrt(RANK_TOLERANCE)
        left = np.flatnonzero(effect)[~mixed]
        variance = residuals @ residuals / max(len(residuals) - count, 1)
        inverse = V[regular].T @ np.diag(s[regular] ** -2.0) @ V[regular]
        covariance = np.full((count, count), np.nan)
        scaled = inverse[np.ix_(~mixed, ~mixed)] / np.outer(lengths[left], lengths[left])
        covariance[np.ix_(left, left)] = variance * scaled
        errors = np.sqrt(np.diag(covariance))
        with np.errstate(all="ignore"):
            correlation = covariance / np.outer(errors, errors)
        without_effect, ambiguous = names[~effect].tolist(), names[effect][mixed].tolist()
        return errors, correlation, tuple(without_effect), tuple(ambiguous)
