"""Messages for numbers with units, other names of velocities, and lines that are not TOML."""

from __future__ import annotations

import time
from pathlib import Path

import pytest

from eomc.base.errors import EomcError
from eomc.scene import hints, toml_text
from eomc.scene.read import parse


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("30 deg", '"30*pi/180"'),
        ("-7.5°", '"-7.5*pi/180"'),
        ("−90 degrees", '"-90*pi/180"'),
        ("60 rpm", '"60*2*pi/60", in rad/s'),
        ("1 kg", "kg in SI: write 1"),
        ("250 mm", "m in SI: write 0.25"),
        ("1e3 mm", "m in SI: write 1"),
        ("9.81 m/s^2", "m/s^2 in SI: write 9.81"),
        ("0.7 kg m^2", "kg m^2 in SI: write 0.7"),
        ("3 N*m", "N*m in SI: write 3"),
        ("5 ms", "s in SI: write 0.005"),
    ],
)
def test_numbers_with_units_suggest_a_remedy(text: str, expected: str) -> None:
    remedy = hints.quantity_remedy(text)
    assert remedy is not None and remedy.endswith(expected)


@pytest.mark.parametrize(
    "text", ["2*m", "2 x", "m g", "1/2", "pi/2", "2 m", "sin x", "1e", "°", ""]
)
def test_formulas_are_not_taken_for_numbers_with_units(text: str) -> None:
    assert hints.quantity_remedy(text, declared={"m"}) is None


@pytest.mark.parametrize(
    "name",
    """dot_theta dottheta dtheta d_theta dtheta_dt dthetadt v_theta vel_theta Dtheta qd_theta
    thetadot thetap theta_d theta_v theta_prime theta_velocity""".split(),
)
def test_other_names_of_velocities_are_recognised(name: str) -> None:
    assert (
        hints.intended_velocity(name, {"x": "coordinates", "theta": "coordinates"}) == "theta_dot"
    )


@pytest.mark.parametrize("name", ["theta", "omega", "dot", "d", "theta_0", "phi_dot"])
def test_other_names_are_not_taken_for_velocities(name: str) -> None:
    assert hints.intended_velocity(name, {"x": "coordinates", "theta": "coordinates"}) == ""


def test_long_texts_are_examined_quickly() -> None:
    start = time.process_time()
    for text in ("1 " + "m " * 500_000, "1" * 1_000_000, "=" + " " * 1_000_000, "m" * 1_000_000):
        hints.quantity_remedy(text), hints.toml_remedy(text), hints.number_remedy(text)
    assert time.process_time() - start < 1


def test_size_of_a_file_is_limited(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(toml_text, "MAX_BYTES", 40)
    file = tmp_path / "long.toml"
    file.write_text("eomc = 1".ljust(40), encoding="utf-8")
    assert toml_text.tree_and_digest(file)[0] == {"eomc": 1}
    file.write_text("eomc = 1".ljust(41), encoding="utf-8")
    with pytest.raises(EomcError, match="more than the 40 bytes"):
        toml_text.tree_and_digest(file)
    with pytest.raises(EomcError, match="more than the 40 bytes"):
        parse(file.read_bytes(), "long.toml")


def test_byte_order_mark_is_ignored(tmp_path: Path) -> None:
    file = tmp_path / "marked.toml"
    file.write_text("eomc = 1", encoding="utf-8-sig")
    assert toml_text.tree_and_digest(file)[0] == {"eomc": 1}


def test_robot_file_is_recognised() -> None:
    with pytest.raises(EomcError, match=r"'eomc import arm\.urdf' writes"):
        parse(b'\n<robot name="arm"/>', "arm.urdf")


def test_units_of_degrees_are_recognised_in_products() -> None:
    for unit in ("deg", "Deg/s", "deg/s^2", "N m/deg", "°", "degrees"):
        assert hints.is_in_degrees(unit), unit
    for unit in ("rad", "°C", "degC", ""):
        assert not hints.is_in_degrees(unit), unit
