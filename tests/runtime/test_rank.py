"""Tests of the rank test for constraint equations and motions."""

from __future__ import annotations

import re

import numpy as np
import pytest

from eomc.base import resources
from eomc.runtime import rank


def test_test_in_c_has_the_same_tolerance() -> None:
    text = (resources.folder("csrc") / "solver" / "projection.c").read_text()
    (factor,) = re.findall(r"DEPENDENT = (\d+)\*EOM_EPS;", text)
    assert rank.tolerance() ** 2 == pytest.approx(int(factor) * np.finfo(float).eps)


@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_rows_that_differ_by_less_than_the_tolerance_are_dependent(dtype: str) -> None:
    least = rank.tolerance(dtype)
    for angle, expected in ((0.5 * least, 2), (8 * least, 1)):
        A = np.array([[1.0, 0.0, 0.0], [1e6, 1e6 * angle, 0.0]])  # units do not count
        basis = rank.null_space(A, dtype)
        assert basis.shape == (3, expected)
        assert basis.T @ basis == pytest.approx(np.eye(expected))


def test_matrix_without_nonzero_rows_has_rank_zero() -> None:
    for m in (0, 2):
        assert rank.null_space(np.zeros((m, 3))).shape == (3, 3)
