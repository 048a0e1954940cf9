"""What XLA compiles: programs that recordings of any length share, and options for large ones on a CPU."""

import functools
from collections.abc import Callable
from typing import Any

import jax
import numpy as np

_CHUNK = 1024
"""Samples that one compiled call takes."""
_ON_CPU = {"xla_backend_optimization_level": 1, "xla_cpu_use_fusion_emitters": False}
_ON_GPU = {"xla_gpu_autotune_level": 0, "xla_gpu_enable_triton_gemm": False}


@functools.cache
def options(platform: str | None = None) -> dict[str, Any] | None:
    """Compiler options for MJX, and for other programs as large, on a CPU; None elsewhere, and where XLA does not
    know them.

    XLA's fusion emitters compute the pose of a link anew wherever MJX uses it, for each link of a chain again:
    inverse dynamics of 100 states takes 0.5 ms with 3 joints, 0.5 s with 7 and 6 s with 9; without them 0.4 to
    1 ms (`experiments/speed/mjx_on_cpu.py`). The solver of the retrieval compiles in a third of the time so, and
    runs as fast.

    Args:
        platform: "cpu", "gpu", …; that of JAX's default device when None.
    """
    return _if_known("cpu", _ON_CPU) if (platform or jax.default_backend()) == "cpu" else None


@functools.cache
def options_of_solver(platform: str) -> dict[str, Any] | None:
    """The same for the solver of the retrieval, and on a GPU too: there XLA tries which of its kernels suits each
    product best, which takes longer than a million starts do and hardly makes them faster
    (`experiments/speed/run.py --gpu`)."""
    return _if_known("gpu", _ON_GPU) if platform == "gpu" else options(platform)


def _if_known(platform: str, some: dict[str, Any]) -> dict[str, Any] | None:
    """These options where XLA of this version knows them."""
    try:
        with jax.default_device(jax.devices(platform)[0]):
            jax.jit(lambda x: x, compiler_options=some).lower(0.0).compile()
    except jax.errors.JaxRuntimeError:
        return None
    return some


def chunked(function: Callable, arm: Any, *arrays: np.ndarray) -> np.ndarray:
    """`function(arm, *arrays)` in chunks of one shape: recordings of any length share its compilation."""
    out = []
    for start in range(0, len(arrays[0]), _CHUNK):
        parts = [filled(a[start : start + _CHUNK], _CHUNK) for a in arrays]
        out.append(np.asarray(function(arm, *parts)))
    return np.concatenate(out)[: len(arrays[0])]


def filled(a: np.ndarray, length: int) -> np.ndarray:
    """Rows up to a length, the last one again and again."""
    short = length - len(a)
    return np.concatenate([a, np.repeat(a[-1:], short, 0)]) if short else a
