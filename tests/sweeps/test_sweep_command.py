"""The command eomc sweep: files of sweeps, options, plots, Ctrl-C."""

from __future__ import annotations

import json
import re
import runpy
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner, Result
from support.session import ROOT
from support.sweep_scene import DRAWS, SCENE, are_equal

from eomc.cli.main import main
from eomc.sweeps.store import Store, draw_plot, open_dataset
from eomc.sweeps.sweep import sweep

pytest.importorskip("zarr")
pytest.importorskip("xarray")

FILE = """\
eomc_sweep = 1
scene      = "sweep_pendulum.toml"
keep       = ["theta", "height.max"]

[over]
l = { from = 1, to = 2, n = 5 }

[draws]
n     = 100
theta = { uniform = [-3, 3] }

[run]
duration = 0.1
"""


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "sweep_pendulum.toml").write_text(SCENE)
    (tmp_path / "basin.toml").write_text(FILE)
    return tmp_path


def call(*arguments: str) -> Result:
    return CliRunner().invoke(main, ["sweep", *arguments])


def test_a_file_is_the_same_sweep_as_a_call(folder: Path) -> None:
    result = call("basin.toml", "--out", "a.zarr", "--json")
    assert result.exit_code == 0, result.output
    values = json.loads(result.stdout)
    assert values["finished"] == values["blocks"] == 3 and values["trajectories"] == 500
    dataset = sweep(
        "sweep_pendulum.toml", over={"l": [1, 1.25, 1.5, 1.75, 2]}, n=100, duration=0.1,
        draws={"theta": DRAWS["theta"]}, outputs=["theta", "height.max"], out="b.zarr",
    )  # fmt: skip
    assert are_equal(dataset, open_dataset(Path("a.zarr")))


def test_options_vary_a_scene(folder: Path) -> None:
    options = ["--over", "l=1:2:5", "--draw", "theta=uniform:-3,3", "--n", "1_00", "--keep"]
    options += ["theta,height.max", "--duration", "0.1"]
    result = call("sweep_pendulum.toml", *options, "--out", "a.zarr")
    assert result.exit_code == 0 and "3 of 3 blocks" in result.output, result.output
    call("basin.toml", "--out", "b.zarr")
    assert are_equal(*(open_dataset(Path(x)) for x in ("a.zarr", "b.zarr")))


def test_status_computes_nothing(folder: Path) -> None:
    assert "has not started, 500 trajectories" in call("basin.toml", "--status").output
    assert not (folder / "build").exists()
    call("basin.toml")
    assert "3 of 3 blocks are finished" in call("basin.toml", "--status").output
    assert "3 of 3 blocks\n" in call("basin.toml").output  # and no rate


@pytest.mark.filterwarnings("error")
def test_a_plot_of_one_part_shows_the_number_of_blocks(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    axes = pytest.importorskip("matplotlib.axes")
    titles: list[str] = []
    monkeypatch.setattr(axes.Axes, "set_title", lambda self, label: titles.append(label))
    result = call("basin.toml", "--part", "2/3", "--plot", "a.png")
    assert result.exit_code == 0 and titles == ["1 of 3 blocks"], result.output


def test_after_ctrl_c_the_same_command_goes_on(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    text = FILE.replace("n     = 100", "n     = 2000")
    (folder / "basin.toml").write_text(text)
    call("basin.toml", "--out", "whole.zarr")
    write, calls = Store.write, []

    def interrupt(store: Store, values: Any) -> None:
        calls.append(1)
        if len(calls) == 5:
            raise KeyboardInterrupt
        write(store, values)

    with monkeypatch.context() as patch:
        patch.setattr(Store, "write", interrupt)
        result = call("basin.toml", "--out", "a.zarr")
    assert result.exit_code == 130
    assert "what is finished stays, and the same command goes on" in result.output
    store = Store(Path("a.zarr"))
    assert 0 < store.finished().sum() < store.blocks
    assert call("basin.toml", "--out", "a.zarr").exit_code == 0
    assert are_equal(*(open_dataset(Path(x)) for x in ("a.zarr", "whole.zarr")))


@pytest.mark.parametrize(
    ("shape", "options"),
    [
        ("histogram", ["--draw", "theta=uniform:-3,3", "--n", "50"]),
        ("curve", ["--over", "theta=-3:3:20"]),
        ("map", ["--over", "theta=-3:3:7", "--over", "theta_dot=-1:1:5"]),
        ("mean", ["--over", "l=1:2:5", "--draw", "theta=uniform:-3,3", "--n", "20"]),
    ],
)
def test_plots_are_drawn_by_shape(shape: str, options: list[str], folder: Path) -> None:
    pytest.importorskip("matplotlib")
    result = call("sweep_pendulum.toml", *options, "--plot", f"{shape}.png")
    assert result.exit_code == 0, result.output
    assert (folder / f"{shape}.png").read_bytes().startswith(b"\x89PNG")


def name_results(runs: Any) -> dict[str, Any]:
    return dict.fromkeys(("gamma", "alpha", "beta", "delta"), runs["theta"][:, -1])


def test_first_result_of_a_function_is_drawn(folder: Path) -> None:
    matplotlib = pytest.importorskip("matplotlib")
    path = Path("named.zarr")
    sweep("sweep_pendulum.toml", over={"m": [1, 2]}, out=path, outputs=name_results)
    with matplotlib.rc_context({"svg.fonttype": "none"}):
        draw_plot(path, Path("named.svg"))
    assert ">alpha</text>" in Path("named.svg").read_text()


def test_parquet_files_have_a_row_for_each_trajectory(folder: Path) -> None:
    pyarrow = pytest.importorskip("pyarrow.parquet")
    result = call("basin.toml", "--parquet", "rows", "--out", "a.zarr")
    assert result.exit_code == 0 and "wrote rows" in result.output, result.output
    table = pyarrow.read_table("rows/block-000001.parquet").to_pandas()
    dataset = open_dataset(Path("a.zarr"))
    assert len(table) == 200
    row = table.iloc[121]
    assert row["theta"] == dataset["theta"].sel(l=row["l"])[int(row["draw"])]


@pytest.mark.slow
def test_the_examples_of_the_documentation_run(tmp_path: Path) -> None:
    examples, page = ROOT / "docs" / "examples" / "sweeps", ROOT / "docs" / "sweeps.md"
    for name in ("basin.toml", "forced_pendulum.toml"):
        assert (examples / name).read_text() in page.read_text()
    few = ["--over", "theta=-3:3:4", "--over", "theta_dot=-4:4:3"]
    picture, out = str(tmp_path / "a.png"), str(tmp_path / "a.zarr")
    result = call(str(examples / "basin.toml"), *few, "--plot", picture, "--out", out)
    assert result.exit_code == 0, result.output
    few = ["--over", "F=1:1.5:3", "--plot", str(tmp_path / "b.png"), "--out", out + "b"]
    result = call(str(examples / "bifurcation.toml"), *few)
    assert result.exit_code == 0, result.output
    arm = runpy.run_path(str(examples / "arm.py"))
    dataset = arm["main"](n=256, out=tmp_path / "c.zarr", picture=tmp_path / "c.png")
    assert 0.05 < np.median(dataset["tip_error"].values) < 0.07
    assert len([*tmp_path.glob("?.png")]) == 3
    for name in ("basin", "bifurcation", "arm"):
        assert f"(examples/sweeps/{name}.png)" in page.read_text()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("[over]", "[ovr]"), "basin.toml:5"),
        (("l = {", "ll = {"), "basin.toml:6"),
        (("n = 5", "n = -5"), "basin.toml:6"),
        (("uniform", "unifrm"), "basin.toml:10.*did you mean 'uniform'"),
        (("n     = 100", ""), "how many draws"),
        (('"theta", ', '"thta", '), "basin.toml:3.*'thta' is no column .*did you mean 'theta'"),
        (("duration = 0.1", 'duration = "a"'), "basin.toml:13.*'a' is not a number"),
        ((FILE, "\n"), "basin.toml: is empty: name a scene in it"),
        (("duration = 0.1", "duratio = 0.1"), "basin.toml:13.*did you mean 'duration'"),
        (("eomc_sweep = 1", "eomc_sweep = 2"), "basin.toml:1"),
        (("[over]", "[over"), "basin.toml:5.*not TOML"),
    ],
)
def test_faults_in_a_file_are_shown_at_their_line(
    change: tuple[str, str], message: str, folder: Path
) -> None:
    (folder / "basin.toml").write_text(FILE.replace(*change))
    result = call("basin.toml")
    assert result.exit_code == 2
    assert re.search(message, result.output), result.output


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--over", "l"], "write NAME=FROM:TO:N"),
        (["--over", "l=1:2"], "--over l=1:2: write NAME=FROM:TO:N"),
        (["--over", "l=1,x"], "--over l=1,x: write NAME="),
        (["--draw", "l=normal:2,x"], "--draw l=normal:2,x: write NAME="),
        (["--draw", "l=normal"], "write NAME=KIND:A,B"),
        (["--part", "3"], "give K/N"),
        (["--part", "0/3"], "part: give K/N with 1 <= K <= N, such as 3/100, here '0/3'"),
        (["--part", "4/3"], "give K/N with 1 <= K <= N"),
        (["--workers", "2", "--scheduler", "tcp://a:1"], "choose one"),
        (["--plot", "a.txt"], "--plot a.txt"),
        (["--status", "--plot", "a.png"], "leave out --plot and --parquet"),
    ],
)
def test_wrong_options_are_refused(options: list[str], message: str, folder: Path) -> None:
    result = call("basin.toml", *options)
    assert result.exit_code == 2 and message in result.output, result.output


def test_a_large_store_needs_a_confirmation(folder: Path) -> None:
    result = call("basin.toml", "--n", "1_000_000_000")
    assert result.exit_code == 2 and "confirm it with --yes" in result.output
    assert not [*folder.glob("build/sweeps/*.zarr")]
