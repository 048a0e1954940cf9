"""Strict in tests, relaxed for users: float64, warnings as errors, shapes checked at run time.

What XLA compiled is kept in `.pytest_cache`, for the workers to share and for the next run.
"""

import os
from pathlib import Path

import jax
import pytest

jax.config.update("jax_enable_x64", True)


def pytest_configure(config: pytest.Config) -> None:
    if config.cache is not None:
        jax.config.update("jax_compilation_cache_dir", str(config.cache.mkdir("jax")))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.2)


@pytest.fixture(scope="session")
def data() -> Path:
    """The folder of real recordings; tests that need it are skipped where it is absent."""
    default = Path(__file__).parents[2] / "shared" / "data"
    folder = Path(os.environ.get("JAXPANDA_DATA") or default)
    if not folder.is_dir():
        pytest.skip("no real recordings here: set JAXPANDA_DATA to the folder that holds them")
    return folder
