"""JAX in double precision for benchmarks/peers.py, on one core."""

from __future__ import annotations

import os
from functools import partial
from typing import Any

import numpy as np
import physics
from physics import Matrices
from runners import Array, Run, timed

os.environ["XLA_FLAGS"] = os.environ.get("XLA_FLAGS", "") + " --xla_cpu_multi_thread_eigen=false"

import jax
import jax.numpy as jnp

jax.config.update("jax_enable_x64", True)


def _steps(matrices: Matrices, x: Any, h: Any, steps: int) -> Any:
    """All steps as one scan; the state is a tuple of scalars, or of rows (batch,)."""

    def step(x: Any, _: None) -> tuple[Any, None]:
        return tuple(physics.rk4(matrices, list(x), h, jnp.sin, jnp.cos)), None

    return jax.lax.scan(step, x, None, length=steps)[0]


def one(matrices: Matrices) -> Run:
    """Compiled whole for a number of steps."""
    compiled = jax.jit(partial(_steps, matrices), static_argnums=2)
    return lambda x, h, steps: np.array(compiled(tuple(map(float, x)), h, steps))


def batch(matrices: Matrices, x0: Array, h: float) -> Run:
    """vmap over the instances, or a map that takes one after the other; the faster is kept."""

    def vmapped(x: Any, h: Any, steps: int) -> Any:
        return jax.vmap(lambda x: _steps(matrices, x, h, steps))(x)

    def mapped(x: Any, h: Any, steps: int) -> Any:
        return jax.lax.map(lambda x: _steps(matrices, x, h, steps), x)

    runs: list[Run] = []
    for form in (vmapped, mapped):
        compiled = jax.jit(form, static_argnums=2)

        def run(x: Array, h: float, steps: int, compiled: Any = compiled) -> Array:
            return np.array(compiled(tuple(map(jnp.asarray, x)), h, steps))

        run(x0, h, 50)
        runs.append(run)
    return min(runs, key=lambda run: min(timed(run, x0, h, 50)[0] for _ in range(3)))
