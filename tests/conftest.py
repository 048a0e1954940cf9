"""Strict in tests, relaxed for users: float64, warnings as errors, shapes checked at run time (but in slow ones).

Most of what tests take is compilation. XLA's older emitters of loops, with LLVM's least optimisation, take a
sixth of the time for programs that take twice as long to run: right where a program runs once or twice. With
`XLA_FLAGS` in the environment, if only a space, tests run on XLA as that says. What was compiled is kept in
`.pytest_cache`, for workers and subprocesses to share and for the next run.
"""

import importlib.util
import inspect
import mmap
import os
from pathlib import Path

import pytest

QUICK_TO_COMPILE = {"xla_cpu_use_fusion_emitters": "false", "xla_backend_optimization_level": "0"}


def knows(flag: str) -> bool:
    """Whether this jaxlib has a flag of XLA's: one that it does not know ends the process."""
    spec = importlib.util.find_spec("jaxlib")
    for folder in spec.submodule_search_locations or () if spec else ():
        for library in Path(folder).glob("libjax_common.*"):
            with library.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content:
                return content.find(flag.encode()) >= 0
    return False


# Before JAX is imported; workers and subprocesses find it in their environment.
for library in ("OPENBLAS", "OMP", "MKL"):
    os.environ.setdefault(f"{library}_NUM_THREADS", "1")  # those of one worker would wait for another's
if "XLA_FLAGS" not in os.environ:
    os.environ["XLA_FLAGS"] = " ".join(f"--{k}={v}" for k, v in QUICK_TO_COMPILE.items() if knows(k))

import jax  # noqa: E402
import jaxtyping  # noqa: E402
from jaxpanda_kernels import scalars  # noqa: E402

jax.config.update("jax_enable_x64", True)

# Products and sums of single numbers took longer to check than to trace; their callers are checked.
for function in filter(inspect.isfunction, vars(scalars).values()):
    function.__no_type_check__ = True


def pytest_configure(config: pytest.Config) -> None:
    if (cache := getattr(config, "cache", None)) is not None:
        folder, seconds = str(cache.mkdir("jax")), 0.02
        jax.config.update("jax_compilation_cache_dir", folder)
        jax.config.update("jax_persistent_cache_min_compile_time_secs", seconds)
        # for subprocesses, and for commands, which then keep theirs there too and not in the user's home
        os.environ["JAX_COMPILATION_CACHE_DIR"] = folder
        os.environ["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = str(seconds)


# fmt: off
LONGEST = (
    "real_arms", "two_sided", "diagnosis", "uncertainty", "discrepancy", "decide", "batched",
    "derivatives", "identification", "commands", "feasible", "meaning", "fleet", "scale", "noise",
    "readme_chain", "ensemble", "demo", "premises", "localise", "ranks", "simulation", "rollout",
    "validation", "comparison", "excitation", "own_effects", "resting", "effects", "hostile",
    "next_motion", "retrieval", "dynamics",
)
# fmt: on
"""Files that take long, the longest first: one that begins when the others end is waited for."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    order = {f"test_{name}.py": place for place, name in enumerate(LONGEST)}
    items.sort(key=lambda item: order.get(item.path.name, len(order)))


def pytest_runtest_setup(item: pytest.Item) -> None:
    # A quarter of a diagnosis: what is slow runs as users have it, without shapes checked.
    jaxtyping.config.update("jaxtyping_disable", item.get_closest_marker("slow") is not None)


@pytest.fixture(scope="session")
def data() -> Path:
    """The folder of real recordings; tests that need it are skipped where it is absent."""
    default = Path(__file__).parents[2] / "shared" / "data"
    folder = Path(os.environ.get("JAXPANDA_DATA") or default)
    if not folder.is_dir():
        pytest.skip("no real recordings here: set JAXPANDA_DATA to the folder that holds them")
    return folder
