"""Who makes shards: this process, or workers of Ray, here or on a cluster.

A worker is a process on one core that keeps what it has compiled, so that only its first recordings compile, and
those read JAX's cache on disk. It is ended and replaced when its memory passes a limit. One that is killed, alone
or with its machine, costs the recording that it was at, which another takes over.
"""

import contextlib
import functools
import importlib
import io
import os
import signal
import socket
import threading
import warnings
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import jax

from .. import session
from ..errors import InputError, MissingExtraError
from ..files import to_json
from . import work
from .work import LOST, Task

ATTEMPTS = 3
"""Workers that a recording may take with it before it is left alone."""
_ANSWER = 20.0
"""How long a cluster may take to answer [s]."""
_STORE = 100_000_000
"""Bytes of Ray's store of objects; no more than sentences and numbers go through it."""


Outcomes = Callable[[Sequence[Task]], Iterator[tuple[int, str]]]
"""The shard of each task, as JSON, with its place, as they are finished."""


@contextlib.contextmanager
def crew(workers: int | None, address: str | None, memory: int) -> Iterator[Outcomes]:
    """Who makes shards, until the body ends; nobody is called before there is something to do.

    Args:
        workers: processes; 0 for this one alone, None for as many as there are cores.
        address: of a Ray cluster, "auto" for the one that this machine belongs to; None to start one here.
        memory: of a worker, beyond which it is replaced [bytes].

    Raises:
        MissingExtraError: Ray is not installed.
        InputError: no cluster at the address, or its machines cannot run the tasks.
    """
    if workers == 0:
        yield functools.partial(_here, memory=memory)
        return
    ray()
    with contextlib.ExitStack() as stack:
        here: list[_Crew] = []

        def outcomes(tasks: Sequence[Task]) -> Iterator[tuple[int, str]]:
            if not here:
                here.append(_Crew(*stack.enter_context(_cluster(workers, address)), address, memory))
            return here[0].outcomes(tasks)

        yield outcomes


def _here(tasks: Sequence[Task], memory: int) -> Iterator[tuple[int, str]]:
    for i, task in enumerate(tasks):
        yield i, work.shard(task)
        if work.memory() > memory:
            work.relieve()


class Worker:
    """A process of Ray's."""

    def node(self) -> str:
        """Which machine this is."""
        return ray().get_runtime_context().get_node_id()

    def process(self) -> int:
        """Its number, for who wants to end it."""
        return os.getpid()

    def settle(self, place: int) -> None:
        """Keep to one core, before anything is compiled: threads would only wait for other workers'."""
        if hasattr(os, "sched_setaffinity"):
            cores = sorted(os.sched_getaffinity(0))
            os.sched_setaffinity(0, {cores[place % len(cores)]})
        jax.config.update("jax_platforms", "cpu")  # as a diagnosis works there; a GPU is others'
        session.start()

    def shard(self, task: Task) -> tuple[str, int]:
        """The shard, and what this process holds by now [bytes]."""
        return work.shard(task), work.memory()


class _Crew:
    """Workers, and which core of which machine each has."""

    def __init__(self, api: Any, count: int, address: str | None, memory: int):
        self.api, self.count, self.address, self.memory = api, count, address, memory
        self.actor = api.remote(num_cpus=1, max_restarts=0)(Worker)
        self.places: dict[Any, tuple[str, int]] = {}
        self.idle: list[Any] = []
        self.called: dict[Any, Any] = {}
        """Workers that have not begun yet, by what will say where they are."""
        self.stillborn = 0
        """Workers that have ended since one last began."""

    def outcomes(self, tasks: Sequence[Task]) -> Iterator[tuple[int, str]]:
        """`Outcomes`: each idle worker takes a task; what a worker had that ended goes to another."""
        waiting = deque((i, 1) for i in range(len(tasks)))
        busy: dict[Any, tuple[Any, int, int]] = {}
        while waiting or busy:
            wanted = min(self.count - len(busy), len(waiting)) - len(self.idle) - len(self.called)
            for worker in [self.actor.remote() for _ in range(wanted)]:
                self.called[worker.node.remote()] = worker
            while waiting and self.idle:
                i, attempt = waiting.popleft()
                worker = self.idle.pop()
                busy[worker.shard.remote(tasks[i])] = worker, i, attempt
            for done in self.api.wait([*busy, *self.called], num_returns=1)[0]:
                if done in self.called:
                    self._begin(done, alone=not busy)
                    continue
                worker, i, attempt = busy.pop(done)
                try:
                    document, used = self.api.get(done)
                except self.api.exceptions.RayTaskError as error:
                    raise InputError(
                        f"{_where(self.address)}: a worker cannot work ({_said(error)})"
                    ) from None
                except self.api.exceptions.RayError as error:
                    self._dismiss(worker)
                    if attempt < ATTEMPTS:
                        waiting.append((i, attempt + 1))
                    else:
                        yield i, to_json(work.refused(tasks[i].key, LOST, _lost(tasks[i], error)))
                    continue
                if used > self.memory:
                    self._dismiss(worker)
                else:
                    self.idle.append(worker)
                yield i, document

    def _begin(self, where: Any, *, alone: bool) -> None:
        """Give a worker that was called a core of its own, while there are enough on its machine."""
        worker = self.called.pop(where)
        try:
            node = self.api.get(where)
        except self.api.exceptions.RayError as error:
            self.stillborn += 1
            if alone and self.stillborn > ATTEMPTS * self.count:
                raise InputError(f"{_where(self.address)}: no worker begins ({_said(error)})") from None
            return
        self.stillborn = 0
        taken = {place for at, place in self.places.values() if at == node}
        place = min(set(range(len(taken) + 1)) - taken)
        self.places[worker] = node, place
        worker.settle.remote(place)
        self.idle.append(worker)

    def _dismiss(self, worker: Any) -> None:
        """End a worker, if it has not ended."""
        self.places.pop(worker, None)
        self.api.kill(worker)


def _said(error: Exception) -> str:
    return " ".join(str(error).split())[-300:]


def _lost(task: Task, error: Exception) -> str:
    said = " ".join(str(error).split()).split(". ")[0][:200]
    return f"{task.recording.name}: {ATTEMPTS} workers ended while they were at it, the last as {said}"


def _where(address: str | None) -> str:
    return f"--address {address}" if address else "Ray on this machine"


@contextlib.contextmanager
def _cluster(workers: int | None, address: str | None) -> Iterator[tuple[Any, int]]:
    """Ray, connected, and how many workers there are to be."""
    if address:  # Ray would tell of every second that it waits for an answer, and wait for minutes
        os.environ.setdefault("RAY_BACKEND_LOG_LEVEL", "fatal")
        require_answer(address)
    api = ray()
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    quiet: dict[str, Any] = {"log_to_driver": False, "logging_level": "CRITICAL"}
    begun = api.is_initialized()
    here = {"num_cpus": workers or cores, "include_dashboard": False, "object_store_memory": _STORE}
    with _own_signals(), warnings.catch_warnings():
        warnings.filterwarnings(
            "ignore", "os.fork", RuntimeWarning
        )  # of JAX; what Ray forks becomes its own at once
        try:
            if not begun:
                api.init(address=address or "local", **quiet, **({} if address else here))
        except (ConnectionError, RuntimeError, ValueError) as error:
            said = " ".join(str(error).split())[:200]
            token = "; one that asks for a token takes it from RAY_AUTH_TOKEN" if address else ""
            raise InputError(f"{_where(address)}: no cluster answers ({said}){token}") from None
    with contextlib.redirect_stdout(
        io.StringIO()
    ):  # where Ray tells of workers that died, and a result will be
        try:
            yield api, workers or max(1, int(api.cluster_resources().get("CPU", 1)))
        finally:
            if not begun:
                api.shutdown()


def require_answer(address: str) -> None:
    """Refuse an address of the form host:port where nothing listens."""
    host, _, port = address.removeprefix("ray://").rpartition(":")
    if address == "auto" or "://" in address.removeprefix("ray://"):
        return
    try:
        socket.create_connection((host.strip("[]"), int(port)), _ANSWER).close()
    except (OSError, ValueError, OverflowError) as error:
        raise InputError(
            f"{_where(address)}: no cluster answers ({error}); HOST:PORT is needed, or auto"
        ) from None


@contextlib.contextmanager
def _own_signals() -> Iterator[None]:
    """SIGTERM ends a command as before: Ray takes it for itself."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.getsignal(signal.SIGTERM)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def ray() -> Any:
    """Ray, told to send nothing home.

    Raises:
        MissingExtraError: it is not installed.
    """
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")
    try:
        return importlib.import_module("ray")
    except ImportError:
        raise MissingExtraError("a fleet with workers (Ray; --workers 0 does without)", "fleet") from None
