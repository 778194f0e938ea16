"""Columns of a run by name, in files and as tables of other libraries."""

from __future__ import annotations

import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest
from support import trajectories
from support.session import Modules
from support.trajectories import QD, Q

from eomc.runtime.package import model_of


@pytest.fixture(scope="session")
def batch() -> ModuleType:
    """Cart-poles with an input that depends on time."""
    return trajectories.module("cartpole_driven")


def law(t: float, q: Any, qd: Any) -> float:
    return float(-10 * q[0] - qd[0] + t)


INPUTS: dict[str, Any] = {
    "signals": None,
    "constant": 0.5,
    "table": np.sin(np.arange(10.0)),
    "function": law,
}


@pytest.fixture(params=INPUTS.values(), ids=list(INPUTS))
def run(request: pytest.FixtureRequest, driven: ModuleType) -> Any:
    """Ten steps, five of whose rows are stored."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            model_of(driven).integrator, "warned", {"u"}
        )  # the warning about slow functions has its own test
        return driven.simulate(Q, QD, steps=10, every=3, u=request.param, t0=0.5)


# --- by name --------------------------------------------------------------------------------------


def test_columns_have_the_names_of_the_scene(driven: ModuleType, run: Any) -> None:
    columns = run.to_dict()
    assert list(columns) == ["t", "x", "theta", "x_dot", "theta_dot", "force", "energy"]
    for k, name in enumerate(driven.coordinates):
        assert np.array_equal(run[name], run.q[:, k])
        assert np.array_equal(run[f"{name}_dot"], run.qd[:, k])
    assert np.array_equal(run.theta, run.q[:, 1]) and np.array_equal(run.theta_dot, run.qd[:, 1])
    assert np.array_equal(run["force"], run.u[:, 0]) and np.array_equal(run.force, run.u[:, 0])
    for name, column in columns.items():
        assert np.array_equal(column, run[name]) and column.shape == (5,), name
    assert np.array_equal(run["t"], run.t) and np.array_equal(run["energy"], run.energy)
    assert {"theta", "force", "q"} <= set(dir(run))
    assert len(dir(run)) == len({*dir(run)})  # a property and a column may share a name


def test_attribute_hides_a_coordinate_but_not_its_column(everything: ModuleType) -> None:
    """The scene's q and u are a coordinate and an input; run.x is the state."""
    run = everything.simulate(steps=3)
    assert run.x.shape == (4, 6) and np.array_equal(run["x"], run.q[:, 0])
    assert np.array_equal(run["q"], run.q[:, 2]) and np.array_equal(run["u"], run.u[:, 0])
    assert list(run.to_dict())[-2:] == ["energy", "jacobi"]  # K is not purely quadratic
    assert np.array_equal(run["jacobi"], run.jacobi)


def test_unknown_name_is_refused_with_a_suggestion(run: Any) -> None:
    with pytest.raises(
        KeyError, match=r"run: 'thetadot' .*force, energy; did you mean 'theta_dot'"
    ):
        run["thetadot"]
    with pytest.raises(AttributeError, match=r"run: 'Theta' .*; did you mean 'theta'\?"):
        _ = run.Theta
    with pytest.raises(TypeError, match=r"run\[0\]: give a name"):
        run[0]
    with pytest.raises(TypeError, match="not iterable"):
        list(run)
    assert not hasattr(run, "__array__") and not hasattr(run, "_nothing")


def test_stored_inputs_are_those_applied(driven: ModuleType) -> None:
    """A row has the inputs held from it on, the last row those before it; signals are evaluated."""
    table, calls = np.cos(np.arange(10.0)), iter(np.cos(np.arange(10.0)))
    tabulated = driven.simulate(steps=10, every=3, u=table)
    assert tabulated.u[:, 0].tolist() == table[[0, 3, 6, 9, 9]].tolist()
    expected, table = tabulated.u.copy(), np.multiply(table, 0, out=table)
    assert np.array_equal(tabulated.u, expected)  # changes of the caller's table have no effect
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(model_of(driven).integrator, "warned", {"u"})
        by_function = driven.simulate(steps=10, every=3, u=lambda t, q, qd: next(calls))
    assert np.array_equal(by_function.u, expected) and np.array_equal(by_function.q, tabulated.q)
    by_signal = driven.simulate(steps=10, every=3, t0=0.5)
    for k, t in enumerate(by_signal.t):
        assert by_signal.u[k] == driven.signal(by_signal.q[k], by_signal.qd[k], t)
    assert driven.simulate(steps=0, u=0.5).u.tolist() == [[0.5]]
    assert np.isnan(driven.simulate(steps=0, u=np.empty((0, 1))).u).tolist() == [[True]]


def test_scene_without_inputs_has_no_input_columns(cartpole: ModuleType) -> None:
    run = cartpole.simulate(steps=2)
    assert run.u.shape == (3, 0)
    assert list(run.to_dict()) == ["t", "x", "theta", "x_dot", "theta_dot", "energy"]


@pytest.mark.parametrize("steps", [6, 7])
def test_stopped_run_has_as_many_inputs_as_rows(driven: ModuleType, steps: int) -> None:
    """A law drives the state beyond the range of numbers."""
    inputs = [*np.arange(float(steps)), 1e308]
    with pytest.warns(RuntimeWarning, match="stopped"), pytest.MonkeyPatch.context() as patch:
        patch.setattr(model_of(driven).integrator, "warned", {"u"})
        run = driven.simulate(steps=20, every=3, u=lambda t, q, qd: inputs[round(t / 0.005)])
    assert (run.status, run.steps) == ("not finite", steps)
    assert run.u[:, 0].tolist() == {6: [0, 3, 1e308], 7: [0, 3, 6, 1e308]}[steps]


# --- batches --------------------------------------------------------------------------------------


@pytest.mark.parametrize("masses", [3.0, [2.0, 3.0, 4.0]])
@pytest.mark.parametrize("inputs", ["signals", "constant", "each", "tables"])
def test_columns_of_a_batch_equal_those_of_its_runs(
    batch: ModuleType, masses: Any, inputs: str
) -> None:
    random = np.random.default_rng(2)
    u = {
        "signals": None, "constant": 0.5, "each": random.random((3, 1)),
        "tables": random.random((3, 10, 1)),
    }[inputs]  # fmt: skip
    q0 = Q + 0.1 * random.random((3, 2))
    options: dict[str, Any] = {"steps": 10, "every": 3, "t0": 0.5}
    runs = batch.simulate_batch(q0, params={"m_c": masses}, u=u, **options)
    names = ["t", "x", "theta", "x_dot", "theta_dot", "force", "energy"]
    assert list(runs.to_dict()) == names
    for k in range(3):
        inputs_of_k = u[k] if inputs in ("each", "tables") else u  # type: ignore[index]
        mass = np.broadcast_to(masses, 3)[k]
        single = batch.simulate(q0[k], params={"m_c": mass}, u=inputs_of_k, **options)
        for name in names:
            actual = runs[name] if name == "t" else runs[name][k]
            np.testing.assert_allclose(actual, single[name], rtol=1e-12, atol=1e-12, err_msg=name)
    assert np.array_equal(runs.theta_dot, runs.qd[..., 1])
    assert runs.energy.shape == runs.jacobi.shape == (3, 5) and runs.u.shape == (3, 5, 1)


def test_batch_stores_copies_of_its_arguments(batch: ModuleType) -> None:
    table, u = np.tile([2.0, 2.0, 2.0, 9.8], (2, 1)), np.ones((2, 4, 1))
    runs = batch.simulate_batch(steps=4, params=table, u=u)
    energy = runs.energy.copy()
    table[:], u[:] = 1.0, 7.0
    assert np.array_equal(runs.energy, energy) and np.all(runs.u == 1.0)


def test_rows_after_a_failure_are_nan_in_all_columns(batch: ModuleType) -> None:
    runs = batch.simulate_batch([[0, 0.1], [0, 0.1]], [[0, 0], [0, 1e155]], steps=5, h=1.0, u=0.5)
    missing = np.isnan(runs.x)
    assert not missing[0].any() and missing[1].any() and not missing[1, 0]
    for name in ("theta_dot", "force", "energy"):
        assert np.array_equal(np.isnan(runs[name]), missing), name


# --- files ----------------------------------------------------------------------------------------


def test_saved_run_is_loaded_unchanged(driven: ModuleType, run: Any, tmp_path: Path) -> None:
    file = tmp_path / "run.npz"
    run.save(file)
    loaded = driven.load_run(file)
    assert loaded == run and (repr(loaded), loaded.message) == (repr(run), run.message)
    for name, column in run.to_dict().items():
        assert np.array_equal(loaded[name], column), name
    assert (loaded.evaluations, loaded.method, loaded.every) == (run.evaluations, run.method, 3)
    if callable(run.request.u):
        with pytest.raises(ValueError, match=r"u was a function.*simulate again"):
            loaded.estimate()
    else:
        assert np.array_equal(loaded.estimate().q, run.estimate().q)
    with np.load(file, allow_pickle=False) as plain:  # readable without the module
        assert np.array_equal(plain["q"], run.q) and str(plain["scene"]) == "cartpole_driven"
        assert all(plain[name].dtype != object for name in plain.files)


def test_saved_batch_is_loaded_unchanged(
    batch: ModuleType, driven: ModuleType, tmp_path: Path
) -> None:
    file = tmp_path / "runs.npz"
    for options in ({}, {"u": 0.5}, {"params": {"m_c": [1.0, 2.0, 3.0]}}):
        runs = batch.simulate_batch(np.tile(Q, (3, 1)), steps=7, every=2, **options)
        runs.save(file)
        loaded = batch.load_run(file)
        assert loaded == runs and np.array_equal(loaded.energy, runs.energy)
        assert np.array_equal(loaded.status, runs.status) and np.array_equal(loaded.u, runs.u)
    batch.simulate(steps=3).save(file)
    assert len(batch.load_run(file)) == 4
    with pytest.raises(ValueError, match=r"save: runs\.csv: give a name that ends in \.npz"):
        runs.save("runs.csv")


def test_parameters_are_loaded_by_name(
    batch: ModuleType, driven: ModuleType, tmp_path: Path
) -> None:
    run = driven.simulate(Q, QD, steps=2, params={"m_c": 3.0})
    run.save(tmp_path / "run.npz")
    for each in (run, driven.load_run(tmp_path / "run.npz")):
        assert each.params == {**driven.defaults, "m_c": 3.0}
    assert np.array_equal(driven.simulate(Q, QD, steps=2, params=run.params).q, run.q)
    masses = np.array([1.0, 2.0, 3.0])
    per_instance = batch.simulate_batch(steps=1, params={"m_c": masses}).params
    assert np.array_equal(per_instance["m_c"], masses) and per_instance["l"].tolist() == [2.0] * 3
    shared = batch.simulate_batch(np.tile(Q, (2, 1)), steps=1).params
    assert shared["m_c"].tolist() == [driven.defaults["m_c"]] * 2


def test_csv_file_has_the_columns(run: Any, tmp_path: Path) -> None:
    file = tmp_path / "run.csv"
    run.save(str(file))
    rows = np.genfromtxt(file, delimiter=",", names=True)
    assert rows.dtype.names == tuple(run.to_dict())
    for name, column in run.to_dict().items():
        assert np.array_equal(rows[name], column), name


def test_file_that_is_no_run_of_this_scene_is_refused(
    driven: ModuleType, cartpole: ModuleType, batch: ModuleType, modules: Modules, tmp_path: Path
) -> None:
    file = tmp_path / "run.npz"

    def expect_refusal(message: str) -> None:
        with pytest.raises(ValueError, match=rf"run\.npz: {message}"):
            driven.load_run(file)

    file.write_text("t,x\n0,1\n", encoding="utf-8")
    expect_refusal("is no whole .npz file")
    np.savez(file, q=np.zeros((2, 2)))
    expect_refusal("was not written by run.save")
    np.savez(file, kind=np.array({}, dtype=object))
    expect_refusal("is no whole .npz file")
    cartpole.simulate(steps=2).save(file)
    expect_refusal("is a run of cartpole, not of cartpole_driven")
    driven.simulate(steps=200).save(file)
    file.write_bytes(file.read_bytes()[:3000])
    expect_refusal("is no whole .npz file")
    driven.simulate(steps=2).save(file)
    with np.load(file) as archive:
        arrays: dict[str, Any] = dict(archive)
    np.savez(file, **arrays | {"parameters": ["m_c", "m_p", "length", "g"]})
    expect_refusal(
        "is a run of another version of .*, whose parameters were m_c, m_p, length, g; here .*l, g"
    )
    np.savez(file, **arrays | {"q": arrays["q"].astype("f4")})
    expect_refusal("has numbers of float32, cartpole_driven float64")
    np.savez(file, **arrays | {"kind": "eomc BatchRun 1"})
    expect_refusal("is a run of many at once")
    np.savez(file, **arrays | {"digest": "another"})
    with pytest.warns(RuntimeWarning, match=r"run\.npz: was saved from another version"):
        assert len(driven.load_run(file)) == 3


def test_files_that_cannot_be_loaded_are_refused_with_advice(
    driven: ModuleType, tmp_path: Path
) -> None:
    advice = r'load_run reads what run\.save\("NAME\.npz"\) wrote'
    file = tmp_path / "missing.npz"
    with pytest.raises(FileNotFoundError, match=rf"No such file .*: {advice}: .*missing") as error:
        driven.load_run(file)
    assert error.value.filename == str(file)
    with pytest.raises(IsADirectoryError, match=rf"Is a directory: {advice}"):
        driven.load_run(str(tmp_path))
    file.write_text("mine", encoding="utf-8")
    with pytest.raises(ValueError, match=rf"missing\.npz: is no whole .*: {advice}$"):
        driven.load_run(file)
    rows = tmp_path / "run.csv"
    driven.simulate(steps=2).save(rows)
    with pytest.raises(ValueError, match=rf"run\.csv: is no .*: {advice}; of a \.csv it has too"):
        driven.load_run(rows)


# --- pandas and xarray ----------------------------------------------------------------------------


@pytest.mark.parametrize("package", ["pandas", "xarray"])
def test_missing_package_is_reported_with_advice(
    run: Any, package: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(
        ModuleNotFoundError, match=rf"to_{package}: {package} is not installed: pip"
    ):
        getattr(run, f"to_{package}")()


def test_pandas(run: Any, batch: ModuleType) -> None:
    pytest.importorskip("pandas")
    table = run.to_pandas()
    assert list(table.columns) == list(run.to_dict())[1:]
    assert table.index.name == "t" and np.array_equal(table.index, run.t)
    assert np.array_equal(table["theta_dot"], run["theta_dot"])
    runs = batch.simulate_batch(np.tile(Q, (3, 1)), steps=4)
    table = runs.to_pandas()
    assert table.index.names == ["instance", "t"] and len(table) == 15
    assert np.array_equal(table.loc[1, "theta"], runs["theta"][1])


def test_xarray(run: Any, batch: ModuleType) -> None:
    pytest.importorskip("xarray")
    data = run.to_xarray()
    assert list(data.data_vars) == list(run.to_dict())[1:]
    assert np.array_equal(data["t"], run.t) and np.array_equal(data["theta"], run["theta"])
    assert (
        data["theta_dot"].attrs == {"units": "rad/s"} and data.attrs["scene"] == "cartpole_driven"
    )
    runs = batch.simulate_batch(np.tile(Q, (3, 1)), steps=4)
    data = runs.to_xarray()
    assert dict(data.sizes) == {"instance": 3, "t": 5}
    assert np.array_equal(data["theta"].sel(instance=1), runs["theta"][1])


def test_arguments_passed_to_pandas_and_xarray(
    run: Any, batch: ModuleType, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Tested with stand-ins, since they may not be installed."""
    monkeypatch.setitem(
        sys.modules,
        "pandas",
        SimpleNamespace(
            Index=lambda values, name: (list(values), name),
            MultiIndex=SimpleNamespace(from_product=lambda parts, names: (parts, names)),
            DataFrame=lambda columns, index: (columns, index),
        ),
    )
    columns, index = run.to_pandas()
    assert index == (list(run.t), "t") and list(columns) == list(run.to_dict())[1:]
    assert np.array_equal(columns["theta_dot"], run["theta_dot"])
    runs = batch.simulate_batch(np.tile(Q, (3, 1)), steps=4)
    columns, ((instances, t), names) = runs.to_pandas()
    assert (list(instances), list(names)) == ([0, 1, 2], ["instance", "t"])
    assert np.array_equal(t, runs.t)
    assert np.array_equal(columns["theta"], runs["theta"].ravel())

    stand_in = SimpleNamespace(Dataset=lambda variables, coords, attrs: (variables, coords, attrs))
    monkeypatch.setitem(sys.modules, "xarray", stand_in)
    variables, coords, attributes = run.to_xarray()
    assert list(variables) == list(run.to_dict())[1:]
    assert coords["t"][::2] == ("t", {"units": "s"}) and np.array_equal(coords["t"][1], run.t)
    axes, values, units = variables["theta_dot"]
    assert (axes, units) == (("t",), {"units": "rad/s"}) and np.array_equal(
        values, run["theta_dot"]
    )
    assert (attributes["scene"], attributes["h"]) == ("cartpole_driven", run.h)
    assert (attributes["method"], len(attributes["digest"])) == (run.method, 64)
    swept = batch.simulate_batch(steps=4, params={"m_c": [1.0, 2.0, 3.0], "l": 2.5})
    axes, values, units = swept.to_xarray()[1]["m_c"]
    assert (axes, values.tolist(), units) == ("instance", [1.0, 2.0, 3.0], {"units": "kg"})
    assert set(swept.to_xarray()[1]) == {"t", "m_c"} and set(runs.to_xarray()[1]) == {"t"}


# --- repr -----------------------------------------------------------------------------------------


def test_repr_fits_on_a_line(
    batch: ModuleType, modules: Modules, everything: ModuleType, driven: ModuleType
) -> None:
    top = modules("heavy_top")
    with pytest.warns(RuntimeWarning):
        stopped = top.simulate(top.start[0] * 0, steps=5)
    assert repr(stopped) == "<Trajectory of heavy_top: singular after 0 steps of 0.002 s>"
    runs = batch.simulate_batch(np.tile(Q, (3, 1)), steps=4, h=0.01)
    expected = "many_cartpole_driven: 3 instances, 12 of 12 steps of 0.01 s: 3 ok"
    assert repr(runs) == f"<BatchTrajectory of {expected}>"
    assert repr(driven) == "<compiled scene cartpole_driven: 2 coordinates, 1 input, 4 parameters>"
    long = repr(everything.Params(gamma=-1.25e-7))
    assert len(long) <= 80 and long.startswith("Params(m=1.5, g=9.81, ") and "more)" in long
    shown = long.count("=")
    assert f"... {len(everything.parameters) - shown} more)" in long
    assert repr(SimpleNamespace(p=driven.Params())) == (
        "namespace(p=Params(m_c=2, m_p=2, l=2, g=9.8))"
    )
