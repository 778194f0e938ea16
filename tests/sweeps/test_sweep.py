"""Values by index, blocks, threads, resumption, refused stores and wrong arguments of sweeps."""

from __future__ import annotations

import errno
import json
import os
import platform
import shutil
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.sweep_scene import DRAWS, SCENE, SWEEP, are_equal

import eomc
from eomc.base.errors import EomcError
from eomc.sweeps import block, plan, store
from eomc.sweeps.store import NOT_RUN, Store, hold_store
from eomc.sweeps.sweep import sweep

pytest.importorskip("zarr")
pytest.importorskip("xarray")

BALL = """
eomc = 1
name = "sweep_ball"
[coordinates]
x = { rate = 3.0 }
y = { start = 1.0 }
[energy]
kinetic   = "(x_dot**2 + y_dot**2)/2"
potential = "9.81*y"
[[event]]
name      = "ground"
when      = "y"
direction = "falling"
action    = "stop"
[run]
h        = 0.01
duration = 2.0
batch    = true
"""


# --- values by index ------------------------------------------------------------------------------


@pytest.mark.parametrize("sampler", plan.SAMPLERS)
def test_values_depend_on_seed_name_and_index_alone(sampler: str) -> None:
    draws = {name: plan.read_distribution((name,), x) for name, x in DRAWS.items()}
    whole = plan.draw_values(draws, (sampler, 3, 1000), 0, 1000)
    for start, stop in ((37, 501), (0, 5), (501, 1000)):
        part = plan.draw_values(draws, (sampler, 3, 1000), start, stop)
        assert all(np.array_equal(part[name], x[start:stop]) for name, x in whole.items())
    other = plan.draw_values(draws, (sampler, 4, 1000), 0, 1000)
    assert not np.array_equal(whole["m"], other["m"])


@pytest.mark.parametrize("sampler", ["random", "sobol"])
def test_a_longer_sweep_begins_with_the_shorter_one(sampler: str) -> None:
    draws = {name: plan.read_distribution((name,), x) for name, x in DRAWS.items()}
    short, long = (plan.draw_values(draws, (sampler, 0, n), 0, n) for n in (300, 700))
    assert all(np.array_equal(x, long[name][:300]) for name, x in short.items())


def test_another_draw_changes_no_random_draw() -> None:
    m = plan.read_distribution(("m",), {"normal": [2, 0.1]})
    one = plan.draw_values({"m": m}, ("random", 0, 50), 0, 50)
    two = plan.draw_values({"l": {"uniform": [1, 2]}, "m": m}, ("random", 0, 50), 0, 50)
    assert np.array_equal(one["m"], two["m"])


@pytest.mark.parametrize(
    ("distribution", "oracle"),
    [
        ({"normal": [2, 0.1]}, ("norm", 2, 0.1)),
        ({"uniform": [-1, 4]}, ("uniform", -1, 5)),
        ({"log_uniform": [0.1, 100]}, ("loguniform", 0.1, 100)),
        ({"truncated_normal": [4, 0.5, 3, 6]}, ("truncnorm", -2, 4, 4, 0.5)),
        ({"truncated_normal": [0, 1, 5, 6]}, ("truncnorm", 5, 6, 0, 1)),
    ],
)
def test_distributions_are_those_of_scipy(distribution: Any, oracle: tuple[Any, ...]) -> None:
    from scipy import stats

    u = plan.random_uniforms(0, "m", 0, 2000)
    frozen = getattr(stats, oracle[0])(*oracle[1:])
    own = plan.inverse_cdf(plan.read_distribution(("m",), distribution), u)
    assert np.allclose(own, frozen.ppf(u), rtol=1e-9, atol=1e-12)
    assert np.array_equal(
        plan.inverse_cdf(plan.read_distribution(("m",), frozen), u), frozen.ppf(u)
    )


# --- no bit depends on blocks, threads, interruptions and parts -----------------------------------


def test_values_are_those_of_one_batch(reference: Any, scene: Path) -> None:
    model = block.load_module("sweep_pendulum", SCENE)
    runs = model.simulate_batch(
        reference["theta_start"].values[:, None], params={"m": reference["m"].values}, threads=1
    )
    assert np.array_equal(reference["theta"], runs["theta"][:, -1])
    assert np.array_equal(reference["theta_dot"], runs["theta_dot"][:, -1])
    assert (reference["status"] == 0).all()


@pytest.mark.parametrize("change", [{"block": 256}, {"block": 512, "threads": 2}])
def test_blocks_and_threads_change_no_bit(
    change: dict[str, Any], reference: Any, scene: Path, tmp_path: Path
) -> None:
    assert are_equal(reference, sweep(scene, **{**SWEEP, **change}, out=tmp_path / "a.zarr"))


def test_reductions_depend_on_no_block(scene: Path, tmp_path: Path) -> None:
    arguments: dict[str, Any] = SWEEP | {
        "over": {"l": [1, 2, 3]},
        "reduce": {
            "theta": ["mean", ("quantile", [0, 0.5, 1])],
            "height": {"histogram": {"from": -3, "to": 3, "n": 13}},
        },
    }
    a, b = (sweep(scene, **arguments, block=k, out=tmp_path / f"{k}.zarr") for k in (256, 4096))
    assert are_equal(a, b)
    whole = sweep(
        scene, **SWEEP, over={"l": [1, 2, 3]}, outputs=["theta", "height"], out=tmp_path / "c.zarr"
    )
    assert np.allclose(a["theta_mean"], whole["theta"].mean("draw"), rtol=1e-12)
    assert np.allclose(a["theta_std"], whole["theta"].std("draw", ddof=1), rtol=1e-12)
    exact = np.quantile(whole["theta"], [0, 0.5, 1], axis=1).T
    assert np.allclose(a["theta_quantile"], exact, rtol=0.004, atol=0.01)
    assert (a["height_histogram"].sum("height_bin") == 1100).all()


def test_moments_leave_out_what_is_not_finite() -> None:
    x = np.array([[1.0, np.nan, 3.0, np.inf], [np.nan] * 4])
    part = store.part_of_block("mean", [], x)[:, None]
    merged = store.merge("mean", [], part)
    assert merged["count"].tolist() == [2, 0]
    assert merged["mean"][0] == 2 and merged["std"][0] == np.sqrt(2)
    assert np.isnan(merged["mean"][1]) and np.isnan(merged["std"][1])


def test_a_sweep_goes_on_after_a_full_disc(
    reference: Any, scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write, calls = Store.write, []

    def write_or_fail(store: Store, values: Any) -> None:
        calls.append(1)
        if len(calls) == 6:
            raise OSError(errno.ENOSPC, "No space left on device")
        write(store, values)

    with monkeypatch.context() as patch:
        patch.setattr(Store, "write", write_or_fail)
        with pytest.raises(EomcError, match=r"no room left on the disc: \d of 5 blocks"):
            sweep(scene, **SWEEP, block=256, out=tmp_path / "a.zarr")
    assert 0 < Store(tmp_path / "a.zarr").finished().sum() < 5
    assert are_equal(reference, sweep(scene, **SWEEP, block=256, out=tmp_path / "a.zarr"))


def test_a_finished_sweep_is_opened_and_not_computed(
    reference: Any, scene: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("eomc.sweeps.sweep.run_block", None)
    store = Path(reference.encoding["source"])
    assert are_equal(reference, sweep(scene, **SWEEP, out=store))


def test_a_deleted_store_is_opened_again_in_the_same_process(
    reference: Any, scene: Path, tmp_path: Path
) -> None:
    for size in (256, 512):
        dataset = sweep(scene, **SWEEP, block=size, out=tmp_path / "a.zarr")
        assert are_equal(reference, dataset)
        shutil.rmtree(tmp_path / "a.zarr")


@pytest.mark.parametrize("sampler", ["random", "sobol"])
def test_a_store_grows_to_more_draws(sampler: str, scene: Path, tmp_path: Path) -> None:
    arguments: dict[str, Any] = SWEEP | {
        "over": {"l": [1, 2]}, "sampler": sampler, "block": 256, "outputs": ["theta"],
        "reduce": {"height": ["mean", ("quantile", [0.5])]},
    }  # fmt: skip
    for n in (700, 1100, 1100):
        grown = sweep(scene, **arguments | {"n": n}, out=tmp_path / "a.zarr")
    whole = sweep(scene, **arguments, out=tmp_path / "b.zarr")
    assert are_equal(grown, whole)
    with pytest.raises(EomcError, match="n: 1100 there, 700 now"):
        sweep(scene, **arguments | {"n": 700}, out=tmp_path / "a.zarr")


def test_few_draws_and_latin_hypercubes_do_not_grow(scene: Path, tmp_path: Path) -> None:
    for sampler, n, message in (("random", 100, "can't grow"), ("latin", 300, "n: 300 there")):
        sweep(scene, **SWEEP | {"n": n, "sampler": sampler}, out=tmp_path / sampler)
        with pytest.raises(EomcError, match=message):
            sweep(scene, **SWEEP | {"n": 1000, "sampler": sampler}, out=tmp_path / sampler)


def test_parts_make_the_whole(reference: Any, scene: Path, tmp_path: Path) -> None:
    for k in (1, 2, 3):
        arguments = SWEEP | {"block": 256, "out": tmp_path / "a.zarr", "part": (k, 3)}
        if k < 3:
            with pytest.warns(RuntimeWarning, match=f"{2 * k} of 5 blocks are finished"):
                dataset = sweep(scene, **arguments)
            assert (dataset["status"] == NOT_RUN).any()
    assert are_equal(reference, sweep(scene, **arguments))


def test_reductions_of_finished_blocks_alone_are_reported(scene: Path, tmp_path: Path) -> None:
    arguments = SWEEP | {"block": 256, "reduce": {"theta": "mean"}, "out": tmp_path / "a.zarr"}
    with pytest.warns(RuntimeWarning, match="2 of 5 blocks .*; reductions are of these alone"):
        dataset = sweep(scene, **arguments, part=(1, 3))
    assert dataset["theta_count"] == 512


def test_failed_trajectories_are_nan_and_counted(scene: Path, tmp_path: Path) -> None:
    draws = {"l": {"log_uniform": [1e-250, 1]}}
    with pytest.warns(RuntimeWarning, match=r"of 500 trajectories failed \(\d+ "):
        dataset = sweep(scene, draws=draws, n=500, out=tmp_path / "a.zarr")
    failed = dataset["status"].values > 0
    assert 0 < failed.sum() < 500
    assert np.isnan(dataset["theta"].values[failed]).all()
    assert np.isfinite(dataset["theta"].values[~failed]).all()


@pytest.mark.slow  # builds adaptive steps
def test_a_limit_of_evaluations_ends_long_trajectories(tmp_path: Path) -> None:
    file = tmp_path / "sweep_adaptive.toml"
    text = SCENE.replace("h        = 0.01", "tolerance = 1e-9").replace("sweep_pendulum", file.stem)
    file.write_text(text, encoding="utf-8")
    arguments: dict[str, Any] = {"over": {"theta_dot": [1.0, 1e5]}, "out": tmp_path / "a.zarr"}
    with pytest.warns(RuntimeWarning, match=r"1 of 2 trajectories failed \(1 too long\)"):
        dataset = sweep(file, **arguments, max_evaluations=2000)
    assert np.isfinite(dataset["theta"]).values.tolist() == [True, False]


# --- what varies, what is stored ------------------------------------------------------------------


def last_crossing(runs: Any) -> dict[str, Any]:
    return {"crossings": (np.diff(np.sign(runs["theta"])) != 0).sum(1).astype(np.int16)}


def test_axes_are_dimensions_and_columns_are_final_values(scene: Path, tmp_path: Path) -> None:
    dataset = sweep(
        scene, over={"theta": [0.1, 0.2], "l": {"from": 1, "to": 100, "n": 3, "scale": "log"}},
        inputs={"torque": 0.0}, outputs=["height", "theta.max", "energy"], out=tmp_path / "a.zarr",
    )  # fmt: skip
    assert dataset["height"].dims == ("theta_start", "l") and dataset["height"].shape == (2, 3)
    assert np.allclose(dataset["l"], [1, 10, 100])
    potential = -9.81 * dataset["l"] * np.cos(dataset["theta_start"])
    assert np.allclose(dataset["energy"], potential.T, rtol=1e-9)
    assert np.allclose(dataset["theta.max"], np.broadcast_to([[0.1], [0.2]], (2, 3)))


def test_times_are_a_dimension_and_functions_have_names_of_their_own(
    scene: Path, tmp_path: Path
) -> None:
    over = {"torque": [0.0, 1.0, 2.0]}
    at_times = sweep(
        scene, over=over, times=[0.0, 0.05, 0.2], outputs=["theta"], out=tmp_path / "a.zarr"
    )
    assert at_times["theta"].dims == ("torque", "t")
    assert (at_times["theta"].sel(t=0) == 0.5).all()
    counted = sweep(scene, over=over, outputs=last_crossing, duration=3.0, out=tmp_path / "b")
    assert counted["crossings"].dtype == np.int16 and (counted["crossings"] > 0).all()


def test_events_have_a_time_a_state_and_a_number(tmp_path: Path) -> None:
    file = tmp_path / "sweep_ball.toml"
    file.write_text(BALL, encoding="utf-8")
    dataset = sweep(
        file, over={"y": [0.5, 1.0, 100.0]}, out=tmp_path / "a.zarr",
        outputs=["ground.time", "ground.count", "ground.x", "ground.y_dot", "x"],
    )  # fmt: skip
    fall = np.sqrt(2 * np.array([0.5, 1.0]) / 9.81)
    assert np.allclose(dataset["ground.time"], [*fall, np.nan], rtol=1e-9, equal_nan=True)
    assert np.allclose(dataset["ground.x"], [*(3 * fall), np.nan], rtol=1e-9, equal_nan=True)
    assert np.allclose(dataset["ground.y_dot"][:2], -9.81 * fall, rtol=1e-9)
    assert dataset["ground.count"].values.tolist() == [1, 1, 0]
    assert np.allclose(dataset["x"], [np.nan, np.nan, 6], equal_nan=True)  # two stopped early
    with pytest.raises(EomcError, match="after ground and a dot: time, count, x"):
        sweep(file, over={"y": [0.5]}, outputs=["ground"], out=tmp_path / "b.zarr")


@pytest.mark.slow
def test_portable_bits_are_another_build_and_another_store(
    reference: Any, scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("EOMC_CFLAGS", "-O1")
    portable = sweep(scene, **SWEEP, bits="portable", out=tmp_path / "a.zarr")
    assert np.allclose(portable["theta"], reference["theta"], rtol=1e-12, atol=1e-12)
    module = block.load_module("sweep_pendulum", SCENE, "portable")
    manifest = Path(str(module.__file__)).parent / "build.json"
    assert json.loads(manifest.read_text())["flags"].endswith("-O1 -ffp-contract=off")
    assert os.environ["EOMC_CFLAGS"] == "-O1"
    with pytest.raises(EomcError, match='bits: "portable" there, "native" now'):
        sweep(scene, **SWEEP, out=tmp_path / "a.zarr")


@pytest.mark.slow
@pytest.mark.skipif(platform.machine() != "x86_64", reason="needs an x86-64 compiler target")
def test_portable_bits_are_equal_with_and_without_fused_multiply_add(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    results = {}
    for bits in ("portable", "native"):
        for target in ("x86-64-v2", "x86-64-v3"):
            monkeypatch.setenv("EOMC_CFLAGS", f"-O3 -march={target}")
            file = tmp_path / f"{target}.toml"  # another text, so another module
            file.write_text(f"{SCENE}# {target}\n", encoding="utf-8")
            out = tmp_path / f"{bits}-{target}.zarr"
            results[bits, target] = sweep(file, **SWEEP, duration=5.0, bits=bits, out=out)
    assert are_equal(results["portable", "x86-64-v2"], results["portable", "x86-64-v3"])
    assert not are_equal(results["native", "x86-64-v2"], results["native", "x86-64-v3"])


# --- refusals -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("change", "difference"),
    [
        ({"seed": 1}, "seed: 0 there, 1 now"),
        ({"sampler": "sobol"}, 'sampler: "random" there, "sobol" now'),
        ({"duration": 0.3}, "duration: nothing there, 0.3 now"),
        (
            {"over": {"l": [1, 2, 3, 4]}},
            r"over.l: nothing there, \[1.0, 2.0, ..., 4.0\] \(4 values",
        ),
        ({"draws": DRAWS | {"m": {"normal": [2, 0.2]}}}, r"draws.m: .*0.1.* there, .*0.2.* now"),
    ],
)
def test_the_store_of_another_sweep_is_refused(
    change: dict[str, Any], difference: str, reference: Any, scene: Path
) -> None:
    with pytest.raises(EomcError, match=rf"holds another sweep: .*\n  {difference}"):
        sweep(scene, **{**SWEEP, **change}, out=reference.encoding["source"])


def test_the_store_of_another_text_of_the_scene_is_refused(reference: Any, tmp_path: Path) -> None:
    (tmp_path / "sweep_pendulum.toml").write_text(f"{SCENE}# changed\n", encoding="utf-8")
    with pytest.raises(EomcError, match=r"another sweep: .*\n  scene: another text there"):
        sweep(tmp_path / "sweep_pendulum.toml", **SWEEP, out=reference.encoding["source"])


def test_a_missing_package_is_named(
    scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "zarr", None)
    with pytest.raises(EomcError, match="sweeps need more packages: pip install zarr"):
        sweep(scene, **SWEEP, out=tmp_path / "a.zarr")


def test_two_sweeps_into_one_store_are_refused(scene: Path, tmp_path: Path) -> None:
    with hold_store(tmp_path / "a.zarr"), pytest.raises(EomcError, match="another sweep writes"):
        sweep(scene, **SWEEP, out=tmp_path / "a.zarr")


def test_another_folder_stays_as_it_is(scene: Path, tmp_path: Path) -> None:
    (tmp_path / "a").mkdir()
    (tmp_path / "a" / "notes.txt").write_text("notes")
    with pytest.raises(EomcError, match="is no store of a sweep, and not empty"):
        sweep(scene, **SWEEP, out=tmp_path / "a")
    with pytest.raises(EomcError, match="is a file: give a folder"):
        sweep(scene, **SWEEP, out=tmp_path / "a" / "notes.txt")
    assert [p.name for p in (tmp_path / "a").iterdir()] == ["notes.txt"]
    assert not [*tmp_path.glob("*.lock")]


NOISE: dict[str, Any] = {"noise": {"torque": {"normal": [0.0, 0.5]}}, "control_period": 0.05}


def damp(t: float, q: Any, qd: Any) -> Any:
    return -2 * q - 0.5 * qd + t


def return_nothing_finite(t: float, q: Any, qd: Any) -> Any:
    return np.full(q.shape, np.nan)


def return_one_number(t: float, q: Any, qd: Any) -> Any:
    return [1.0, 2.0, 3.0]


def test_noise_depends_on_the_index_alone(scene: Path, tmp_path: Path) -> None:
    draws = {"theta": DRAWS["theta"]}
    one = sweep(scene, draws=draws, n=600, block=256, **NOISE, out=tmp_path / "a.zarr")
    two = sweep(scene, over={"m": [1.0, 2.0]}, draws=draws, n=600, **NOISE, out=tmp_path / "b.zarr")
    assert np.array_equal(one["theta"].values, two["theta"].values[0])  # the scene has m = 1
    uniforms = plan.random_uniforms(0, "noise torque", 0, 4 * 600).reshape(600, 4)
    noise = plan.inverse_cdf({"normal": [0.0, 0.5]}, uniforms)
    starts = {"theta": one["theta_start"].values}
    runs = eomc.load(scene).simulate_batch(starts, u={"torque": noise}, control_period=0.05)
    assert np.array_equal(one["theta"].values, runs.q[:, -1, 0])
    grid = sweep(
        scene, over={"m": [1.0], "theta": starts["theta"]}, block=256, **NOISE,
        out=tmp_path / "c.zarr",
    )  # fmt: skip
    assert np.array_equal(one["theta"].values, grid["theta"].values[0])


def test_policies_are_called_once_in_each_control_period(scene: Path, tmp_path: Path) -> None:
    starts = np.linspace(-1.0, 1.0, 5)
    arguments: dict[str, Any] = {"over": {"theta": starts}, "policy": damp, "control_period": 0.03}
    dataset = sweep(scene, **arguments, out=tmp_path / "a.zarr")
    module = eomc.load(scene)
    runs = [module.simulate([x], u=damp, control_period=0.03) for x in starts]
    expected = [run.q[-1, 0] for run in runs]
    assert dataset["theta"].values == pytest.approx(expected, rel=1e-13)
    noisy = sweep(scene, **{**arguments, **NOISE}, out=tmp_path / "b.zarr")
    assert not np.any(noisy["theta"].values == dataset["theta"].values)
    with pytest.raises(EomcError, match="policy: another text there"):
        sweep(scene, **{**arguments, "policy": return_one_number}, out=tmp_path / "a.zarr")


def test_different_processors_are_reported(scene: Path, tmp_path: Path) -> None:
    arguments: dict[str, Any] = {"over": {"m": [1, 2, 3]}, "out": tmp_path / "a.zarr"}
    sweep(scene, **arguments)
    Store(tmp_path / "a.zarr").mark_processor("another processor")
    with pytest.warns(RuntimeWarning, match="workers have different processors"):
        dataset = sweep(scene, **arguments)
    assert {*dataset.variables} == {"status", "theta", "theta_dot", "m"}


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({}, "nothing varies"),
        ({"over": {"m": {"from": 1, "to": 1, "n": 3}}}, "from and to are both 1"),
        ({"over": {"m": [1]}, "control_period": 0.1}, "control_period: goes with noise or a"),
        ({"over": {"m": [1]}, "keep": ["theta"]}, "keep: in Python .* outputs="),
        ({"over": {"m": [1]}, **NOISE, "control_period": 0.013}, "control_period: .* 1.3 steps"),
        ({"over": {"m": [1]}, "noise": {"torqe": {"normal": [0, 1]}}}, "did you mean 'torque'"),
        ({"over": {"m": [1]}, "noise": {"torque": {"normal": [0]}}}, "torque: normal has the"),
        ({"over": {"m": [1]}, "policy": return_nothing_finite}, "policy: return finite numbers"),
        ({"over": {"m": [1]}, "policy": return_one_number}, r"policy: return .*shape \(1, 1\)"),
        ({"draws": DRAWS}, "n: how many draws"),
        ({"over": {"thetta": [1]}}, "thetta: no coordinate, .*did you mean 'theta'"),
        ({"over": {"m": [1]}, "draws": DRAWS, "n": 3}, "m: is in over as well"),
        ({"over": {"m": []}}, "m: give a list of numbers"),
        ({"over": {"m": [1, np.nan]}}, "m: give a list of numbers"),
        ({"over": {"m": {"from": -1, "to": 1, "n": 3, "scale": "log"}}}, "positive limits"),
        ({"over": {"m": {"from": 1, "to": 2, "m": 3}}}, "m: no key 'm' of an axis"),
        ({"over": {"m": {"from": 1, "to": 2}}}, "m: n is missing; give a list"),
        ({"over": {"m": {"from": 1, "to": "x", "n": 3}}}, "m: to is no finite number: 'x'"),
        ({"draws": {"m": {"norma": [1, 2]}}, "n": 3}, "did you mean 'normal'"),
        ({"draws": {"m": {"normal": ["a", 1]}}, "n": 3}, r"\[mean, deviation\]"),
        ({"draws": {"m": {"normal": [1]}}, "n": 3}, r"\[mean, deviation\]"),
        # the wrong seed, which is reported later, ends these sweeps if their size is not refused
        ({"draws": DRAWS, "n": 10**8, "sampler": "latin", "seed": -1}, 'take "sobol"'),
        (
            {"draws": DRAWS, "n": 2**30 + 1, "sampler": "sobol", "seed": -1},
            r"end at 2\*\*30: take .random",
        ),
        ({"draws": DRAWS, "n": 3, "sampler": "sobel"}, "did you mean 'sobol'"),
        ({"over": {"m": [1]}, "outputs": ["height.mx"]}, "max, min, end"),
        ({"over": {"m": [1]}, "outputs": ["hight"]}, "did you mean 'height'"),
        ({"over": {"m": [1]}, "reduce": {"theta": "mean"}}, "reductions are over draws"),
        ({"over": {"m": [1]}, "durations": 3}, "did you mean 'duration'"),
        ({"over": {"m": [1]}, "duration": -1.0}, "^duration: "),
        ({"over": {"m": [1]}, "inputs": {"force": 1.0}}, "force: no input"),
        ({"over": {"m": [1]}, "client": object()}, "client: give an Executor"),
        ({"over": "m"}, "over: give a dict of names and values, here 'm'"),
        ({"over": {"m": [1]}, "client": 0}, "client: give 1 or more, here 0"),
        ({"over": {"m": [1]}, "threads": 0}, "threads: give 1 or more, here 0"),
        ({"over": {"m": [1]}, "block": -3}, "block: give 1 or more, here -3"),
        ({"over": {"m": [1]}, "part": (0, 3)}, r"part: give K/N .* here \(0, 3\)"),
        ({"over": {"m": [1]}, "part": 3}, "part: give K/N .* here 3"),
        ({"over": {"m": [1]}, "outputs": lambda runs: {"a": 1.0}}, "a row for each"),
    ],
)
def test_wrong_arguments_are_refused_with_the_remedy(
    arguments: dict[str, Any], message: str, scene: Path, tmp_path: Path
) -> None:
    with pytest.raises(EomcError, match=message):
        sweep(scene, **arguments, out=tmp_path / "a.zarr")


def test_a_system_and_a_scene_without_batches_are_refused(tmp_path: Path) -> None:
    file = tmp_path / "sweep_single.toml"
    file.write_text(SCENE.replace("batch    = true", "").replace("sweep_pendulum", file.stem))
    with pytest.raises(EomcError, match="batch = true under"):
        sweep(file, over={"m": [1]})
    with pytest.raises(EomcError, match="write it as a scene"):
        sweep(eomc.read(file), over={"m": [1]})
