"""Columns of a run by name: as items, attributes, a dict, a file, pandas or xarray tables.

The names are t, the scene's coordinates, their rates (`theta_dot`), its inputs and outputs, energy,
and jacobi where that is not the energy.
"""

from __future__ import annotations

import csv
from collections.abc import Callable, Iterable
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from .arguments import Array, not_one_of
from .atomic_write import File, atomic_write
from .interfaces import CompiledModel


class Columns:
    """Mixin of runs: access to columns by name, and their conversion to tables and files.

    A column is a quantity at all rows: the time t (n,), a coordinate, its velocity (`theta_dot` for
    the coordinate theta), an input, an output, the energy or the Jacobi integral. For a batch all
    columns but t have the shape (batch, n).
    """

    model: CompiledModel
    outputs: Any  # by name
    parameter_values: Array
    __len__: Callable[[], int]
    _axes: ClassVar[tuple[str, ...]] = ("t",)
    __iter__ = None  # `for name in run` would ask for run[0]

    def _columns(self) -> dict[str, Callable[[], Array]]:
        """Return a function for each column that computes it, by name in the order of `to_dict`."""
        columns: dict[str, Callable[[], Array]] = {
            "t": partial(getattr, self, "t"),
            **self._named(),
        }
        names = ("energy", "jacobi") if self.model.functions.has_jacobi else ("energy",)
        for name in names:
            # a coordinate may have this name
            columns.setdefault(name, partial(getattr, self, name))
        return columns

    def _named(self) -> dict[str, Callable[[], Array]]:
        """Return the columns of the scene's coordinates, rates, inputs and outputs."""
        model = self.model
        rates = [f"{name}_dot" for name in model.info.coordinates]
        halves = (("q", model.info.coordinates), ("qd", rates), ("u", model.info.inputs))
        columns: dict[str, Callable[[], Array]] = {
            name: partial(self._column, half, k)
            for half, names in halves
            for k, name in enumerate(names)
        }
        return columns | {name: partial(self._output, name) for name in model.info.outputs}

    def _output(self, name: str) -> Array:
        values: Array = self.outputs[name]
        return values

    def _column(self, half: str, k: int) -> Array:
        column: Array = getattr(self, half)[..., k]
        return column

    def __getitem__(self, name: str) -> Array:
        if not isinstance(name, str):
            raise TypeError(f"run[{name!r}]: give a name, such as run['t']; rows are run.q[k]")
        columns = self._columns()
        if name not in columns:
            raise KeyError(not_one_of("run", name, tuple(columns)))
        return columns[name]()

    def __getattr__(self, name: str) -> Any:
        """Return the column of that name from the scene, unless a member has the same name."""
        named = {} if name.startswith("_") or "model" not in self.__dict__ else self._named()
        if name not in named:
            known = tuple(named)
            raise AttributeError(not_one_of("run", name, known) if known else name)
        return named[name]()

    def __dir__(self) -> Iterable[str]:
        return {*super().__dir__(), *self._named()}

    @property
    def params(self) -> dict[str, Any]:
        """Return the parameters of the run as a dict from name to number.

        For a batch, the values are arrays (batch,). The dict has the form of the argument `params`
        of `simulate` and `simulate_batch`.
        """
        names, table = self.model.info.parameters, self.parameter_values
        if table.ndim == 1:
            return dict(zip(names, table.tolist(), strict=True))
        columns = np.broadcast_to(table, (len(self), len(names))).T.copy()
        return dict(zip(names, columns, strict=True))

    def to_dict(self) -> dict[str, Array]:
        """Return all columns as a dict from name to array (n,), for a batch (batch, n).

        The order is: t (always (n,)), coordinates, velocities, inputs, outputs, energy, and jacobi
        if the Jacobi integral differs from the energy.
        """
        return {name: column() for name, column in self._columns().items()}

    def save(self, file: File) -> None:
        """Write the columns to a .csv file, or the whole run to an .npz file.

        `load_run` reads the .npz file. It contains arrays only and nothing pickled, so that
        numpy.load(file)["q"] reads it without the module. If u is a function, its values at the
        rows are saved, not the function.

        Parameters
        ----------
        file : path
            A name that ends in .csv (single runs only) or .npz.

        Raises
        ------
        ValueError
            If the name has another suffix, or for the .csv of a batch.
        FileExistsError
            If `file` exists and is a scene, or its content does not match its suffix.
        """
        path = Path(file)
        if path.suffix == ".csv" and self._axes == ("t",):
            self._to_csv(path)
        elif path.suffix == ".npz":
            from .saved import write

            write(self, path)
        else:
            names = ".npz or .csv" if self._axes == ("t",) else ".npz"
            raise ValueError(f"save: {file}: give a name that ends in {names}")

    def _to_csv(self, path: Path) -> None:
        columns = self.to_dict()
        with atomic_write(path) as new, new.open("w", newline="", encoding="utf-8") as file:
            writer = csv.writer(file)
            writer.writerow(columns)
            numbers = (c.astype(float) + 0.0 for c in columns.values())  # -0 becomes 0
            for row in zip(*(c.tolist() for c in numbers), strict=True):
                writer.writerow(map(repr, row))

    def to_pandas(self) -> Any:
        """Return a pandas.DataFrame with one column for each column of the run.

        The index is t, for a batch (instance, t). Raises ModuleNotFoundError if pandas is not
        installed.
        """
        pandas = imported("pandas", "to_pandas")
        columns = self.to_dict()
        t = columns.pop("t")
        if self._axes == ("t",):
            index = pandas.Index(t, name="t")
        else:
            index = pandas.MultiIndex.from_product([range(len(self)), t], names=self._axes)
        return pandas.DataFrame({n: c.ravel() for n, c in columns.items()}, index=index)

    def to_xarray(self) -> Any:
        """Return an xarray.Dataset with one variable for each column of the run.

        The dimension is t, for a batch (instance, t). The attribute `units` of a variable is its
        unit. Parameters that differ between the instances of a batch become coordinates along
        instance. Raises ModuleNotFoundError if xarray is not installed.
        """
        xarray = imported("xarray", "to_xarray")
        model, columns = self.model, self.to_dict()
        units = dict(model.info.units)
        units |= {f"{c}_dot": f"{units[c]}/s" for c in model.info.coordinates if units.get(c)}
        t = ("t", columns.pop("t"), {"units": "s"})
        variables = {
            name: (self._axes, column, {"units": units[name]} if name in units else {})
            for name, column in columns.items()
        }
        attributes = {name: getattr(self, name) for name in ("h", "method")}
        attributes |= {"scene": model.info.name, "digest": model.info.digest}
        coordinates = {"t": t} | self._swept(units, {*variables, *self._axes})
        return xarray.Dataset(variables, coords=coordinates, attrs=attributes)

    def _swept(self, units: dict[str, str], taken: set[str]) -> dict[str, Any]:
        """Return the parameters that differ between instances by name (params_NAME if taken)."""
        if self.parameter_values.ndim == 1 or len(self.parameter_values) == 1:
            return {}
        return {
            f"params_{name}" if name in taken else name: (
                "instance", values, {"units": units[name]} if name in units else {},
            )
            for name, values in self.params.items()
            if np.ptp(values) > 0
        }  # fmt: skip


def imported(package: str, function: str) -> Any:
    """Import and return an optional package such as pandas.

    package: name of the package. function: name of the function that needs it, for the error
    message. If the package is missing, ModuleNotFoundError says how to install it.
    """
    try:
        return import_module(package)
    except ModuleNotFoundError as fault:
        name = package.split(".")[0]
        if fault.name != name:
            raise
        raise ModuleNotFoundError(
            f"{function}: {name} is not installed: pip install {name}, or take to_dict()",
            name=name,
        ) from None
