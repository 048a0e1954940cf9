"""Processes that share one computation: they find each other, exchange arrays, and end together.

Rank 0 listens, every other rank has one connection to it. What each sends is small beside what it computes, and
who leaves, falls silent or fails ends all others with a sentence, which collectives of a GPU library do not.
"""

import contextlib
import json
import os
import queue
import re
import signal
import socket
import struct
import sys
import threading
import time
from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from .errors import InputError, RankError, printable

WAIT = 10.0
"""Seconds within which all ranks must have come."""
SILENCE = 10.0
"""Seconds without a word after which a rank counts as lost; each sends one every `_BEAT` seconds."""
GRACE = 6.0
"""Seconds that a computation has to end after another rank failed; then its process does."""
_BEAT = 1.0
_INTERRUPT = signal.SIGUSR1
_FRAME = struct.Struct("<cQ")  # kind, bytes that follow
_HELLO, _WELCOME, _ALIVE, _DATA, _FAILED, _DONE = b"h", b"w", b"a", b"d", b"f", b"e"
_SHORT, _LONG = 1 << 16, 1 << 34  # bytes of a frame before and after a rank is known


class Ranks:
    """This process among `count`, all of which make the same calls in the same order.

    Attributes:
        rank: from 0.
        count: how many there are.
    """

    rank = 0
    count = 1

    def gather(self, arrays: Sequence[np.ndarray]) -> list[list[np.ndarray]]:
        """The arrays of every rank, in the order of the ranks, at every rank."""
        return [list(arrays)]

    def require_same(self, given: Mapping[str, str]) -> None:
        """Refuse to go on where ranks were given different things, at every rank.

        Args:
            given: what decides the result, under the names that a refusal gives.

        Raises:
            InputError: some rank's differ from rank 0's.
        """
        sent = np.frombuffer(json.dumps(dict(given), sort_keys=True).encode(), np.uint8)
        first, *others = (json.loads(part[0].tobytes()) for part in self.gather([sent]))
        for rank, other in enumerate(others, 1):
            if differing := [
                name for name in first.keys() | other.keys() if first.get(name) != other.get(name)
            ]:
                raise InputError(
                    f"rank {rank} has other {', '.join(sorted(differing))} than rank 0; give every rank the same"
                )


ALONE = Ranks()


@contextlib.contextmanager
def joined(processes: str) -> Iterator[Ranks]:
    """The ranks of a run, from when all have come to when the first has ended.

    Where another rank fails while this process computes, it is interrupted, and ended if that takes too long.

    Args:
        processes: `RANK/COUNT@HOST:PORT`; "auto" for Slurm's; "" for a process alone.

    Raises:
        InputError: malformed, somebody is missing or uses the port, or another rank's input was refused.
        RankError: another rank failed.
    """
    if not processes:
        yield ALONE
        return
    rank, count, host, port = _address(processes)
    if count == 1:
        yield ALONE
        return
    together = _Together(rank, count)
    try:
        try:
            together.meet(host, port)
            yield together
            together.leave()
        except KeyboardInterrupt:
            raise
        except InputError as error:
            together.fail(f"rank {rank}: {error}", 2)
            raise
        except BaseException as error:
            together.fail(f"rank {rank}: {' '.join(str(error).split()) or type(error).__name__}", 1)
            raise
    except KeyboardInterrupt as stop:  # that of another's failure may come while an error is raised
        together.fail(f"rank {rank} was interrupted", 1)
        raise together.error(str(stop)) or stop from None
    finally:
        together.close()


def _address(processes: str) -> tuple[int, int, str, int]:
    """Rank, count, host and port."""
    if processes == "auto":
        return _of_slurm()
    found = re.fullmatch(r"(\d{1,6})/(\d{1,6})@(.+):(\d{1,5})", processes)
    if found is None or not int(found[1]) < int(found[2]) or not 0 < int(found[4]) < 1 << 16:
        raise InputError(
            f"--processes {processes}: expected RANK/COUNT@HOST:PORT with RANK from 0 to COUNT - 1, such as "
            "0/2@192.168.0.1:12345, or auto"
        )
    return int(found[1]), int(found[2]), found[3].strip("[]"), int(found[4])


def _of_slurm() -> tuple[int, int, str, int]:
    """As `srun` tells each of its tasks; the port follows from the job and its step."""
    given = os.environ
    try:
        rank = int(given["SLURM_PROCID"])
        count = int(given.get("SLURM_STEP_NUM_TASKS") or given["SLURM_NTASKS"])
        nodes = given.get("SLURM_STEP_NODELIST") or given["SLURM_JOB_NODELIST"]
        job = int(given["SLURM_JOB_ID"]) + int(given.get("SLURM_STEP_ID", "0"))
    except (KeyError, ValueError):
        raise InputError(
            "--processes auto: this is no task of Slurm (SLURM_PROCID, SLURM_NTASKS, SLURM_JOB_NODELIST, "
            "SLURM_JOB_ID are not all set); with another launcher write RANK/COUNT@HOST:PORT with its variables"
        ) from None
    first = re.match(r"([^,\[]+)(?:\[([^,\-\]]+))?", nodes)  # gpu[07-09,12],other: gpu07
    if first is None or not rank < count:
        raise InputError(f"--processes auto: no rank and host in SLURM_PROCID {rank}, nodes {nodes!r}")
    return rank, count, first[1] + (first[2] or ""), 61440 + job % 4096


class _Line:
    """A connection to another rank; whole frames only."""

    def __init__(self, connection: socket.socket, rank: int):
        self.rank = rank
        self.arrived: queue.Queue[bytes] = queue.Queue()
        self._connection = connection
        self._sending = threading.Lock()
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

    def send(self, kind: bytes, content: bytes = b"") -> None:
        with self._sending:
            self._connection.sendall(_FRAME.pack(kind, len(content)))
            self._connection.sendall(content)

    def receive(self, most: int) -> tuple[bytes, bytes]:
        """Raises EOFError where it was closed or what comes is no frame, TimeoutError where nothing comes."""
        kind, size = _FRAME.unpack(self._exactly(_FRAME.size))
        if size > most:
            raise EOFError
        return kind, self._exactly(size)

    def expect(self, wanted: bytes) -> bytes:
        """What comes in a frame of this kind; EOFError where another comes."""
        kind, content = self.receive(_SHORT)
        if kind != wanted:
            raise EOFError
        return content

    def _exactly(self, size: int) -> bytes:
        content = bytearray()
        while len(content) < size:
            part = self._connection.recv(min(size - len(content), 1 << 20))
            if not part:
                raise EOFError
            content += part
        return bytes(content)

    def limit(self, seconds: float) -> None:
        self._connection.settimeout(max(seconds, 0.1))

    def close(self) -> None:
        with contextlib.suppress(OSError):
            self._connection.shutdown(socket.SHUT_RDWR)
        self._connection.close()


class _Together(Ranks):
    """See `joined`."""

    def __init__(self, rank: int, count: int):
        self.rank, self.count = rank, count
        self._lines: list[_Line] = []
        self._ended = threading.Event()  # here: nothing that others do matters any more
        self._done = threading.Event()  # at rank 0
        self._failure: tuple[str, int] | None = None
        self._lock = threading.Lock()
        self._ending = False  # here: what an interrupt would say is known
        self._in_main = threading.current_thread() is threading.main_thread()
        if self._in_main:  # SIGINT is ignored in what a script starts in the background
            self._handler = signal.signal(_INTERRUPT, self._interrupted)

    # How they find each other

    def meet(self, host: str, port: int) -> None:
        until = time.monotonic() + WAIT
        try:
            socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)
        except socket.gaierror as error:
            raise InputError(f"--processes: {host}: {error.strerror}") from None
        if self.rank == 0:
            self._await_others(host, port, until)
        else:
            self._lines = [self._find_first(host, port, until)]
        for line in self._lines:
            line.limit(SILENCE)
            threading.Thread(target=self._listen, args=(line,), daemon=True).start()
        threading.Thread(target=self._beat, daemon=True).start()

    def _await_others(self, host: str, port: int, until: float) -> None:
        """Rank 0: the lines of all others, in their order."""
        try:
            server = _listening(host, port, self.count)
        except OSError as error:
            raise InputError(
                f"--processes: cannot listen at {host}:{port} ({os.strerror(error.errno or 0)})"
            ) from None
        came: dict[int, _Line] = {}
        with server:
            while len(came) < self.count - 1:
                server.settimeout(max(until - time.monotonic(), 0.01))
                try:
                    line = _Line(server.accept()[0], -1)
                except TimeoutError:
                    break
                line.limit(2.0)
                try:
                    said = json.loads(line.expect(_HELLO))
                    line.rank, count = int(said["rank"]), int(said["count"])
                    line.send(_ALIVE)
                except (OSError, EOFError, ValueError, KeyError, TypeError):  # nobody of ours
                    line.close()
                    continue
                self._lines.append(line)
                if count != self.count:
                    raise InputError(
                        f"--processes: rank {line.rank} says {count} processes, rank 0 {self.count}"
                    )
                if line.rank in came:
                    raise InputError(f"--processes: there are two ranks {line.rank}")
                came[line.rank] = line
        self._lines = [came[rank] for rank in sorted(came)]
        if missing := [str(rank) for rank in range(1, self.count) if rank not in came]:
            who = f"rank{'s' if len(missing) > 1 else ''} {', '.join(missing)}"
            raise InputError(
                f"--processes: {who} of {self.count} did not come within {WAIT:g} s; start all of them together"
            )
        self._send_all(_WELCOME)

    def _find_first(self, host: str, port: int, until: float) -> _Line:
        """Other ranks: the line to rank 0."""
        where = f"{host}:{port}"
        while True:
            try:
                left = max(until - time.monotonic(), 0.1)
                line = _Line(socket.create_connection((host, port), timeout=left), 0)
                break
            except OSError as error:
                if time.monotonic() > until:
                    why = error.strerror or str(error)
                    raise InputError(
                        f"--processes: rank 0 was not found at {where} within {WAIT:g} s ({why}); "
                        "start all of them together"
                    ) from None
                time.sleep(0.1)
        kind, content = b"", b""
        with contextlib.suppress(OSError, EOFError):
            line.limit(3.0)
            line.send(_HELLO, json.dumps({"rank": self.rank, "count": self.count}).encode())
            line.expect(_ALIVE)
            kind = _ALIVE
            line.limit(WAIT + 3.0)  # rank 0 waits for others
            kind, content = line.receive(_SHORT)
        if kind == _WELCOME:
            return line
        line.close()
        if kind == _FAILED:
            raise self._told(content)
        if kind == _ALIVE:
            raise RankError("rank 0 ended before all ranks had come")
        raise InputError(f"--processes: what answers at {where} is not rank 0 of this run")

    # What they tell each other

    def gather(self, arrays: Sequence[np.ndarray]) -> list[list[np.ndarray]]:
        own = _packed(arrays)
        if self.rank == 0:
            parts = [own, *(self._next(line) for line in self._lines)]
            whole = _packed([np.frombuffer(part, np.uint8) for part in parts])
            self._send_all(_DATA, whole)
        else:
            self._send_all(_DATA, own)
            parts = [part.tobytes() for part in _unpacked(self._next(self._lines[0]))]
        return [_unpacked(part) for part in parts]

    def _next(self, line: _Line) -> bytes:
        while True:
            with contextlib.suppress(queue.Empty):
                return line.arrived.get(timeout=0.5)
            if (error := self.error()) is not None:
                raise error

    def _send_all(self, kind: bytes, content: bytes = b"") -> None:
        for line in self._lines:
            with contextlib.suppress(OSError):  # who listens to it hears why it is gone
                line.send(kind, content)

    def _beat(self) -> None:
        while not self._ended.wait(_BEAT):
            self._send_all(_ALIVE)

    def _listen(self, line: _Line) -> None:
        while not self._ended.is_set():
            try:
                kind, content = line.receive(_LONG)
            except TimeoutError:
                return self._lost(line, f"has said nothing for {SILENCE:g} s")
            except (OSError, EOFError):
                return self._lost(line, "ended")
            if kind == _DATA:
                line.arrived.put(content)
            elif kind == _DONE:
                self._done.set()
                return None
            elif kind == _FAILED:
                error = self._told(content)
                return self._stop(str(error), 2 if isinstance(error, InputError) else 1)
        return None

    @staticmethod
    def _told(content: bytes) -> InputError | RankError:
        """What another rank said when it failed."""
        status, said = content[:1], content[1:].decode(errors="replace")
        return InputError(said) if status == b"2" else RankError(said)

    # How they end

    def leave(self) -> None:
        """The work is done: rank 0 says so, and nobody ends before it."""
        if self.rank == 0:
            self._ended.set()
            self._send_all(_DONE)
        else:
            while not self._done.wait(0.5):
                if (error := self.error()) is not None:
                    raise error
            self._ended.set()

    def fail(self, said: str, status: int) -> None:
        """Tell the others, unless they told it."""
        self._ending = True
        with self._lock:
            self._ended.set()
        if self._failure is None or self.rank == 0:
            said, status = self._failure or (said, status)
            self._send_all(_FAILED, f"{status}{said}".encode())

    def error(self, further: str = "") -> InputError | RankError | None:
        """What another rank's failure is here; None while there is none."""
        if self._failure is None:
            return None
        said, status = self._failure
        said = f"{said}; {further}" if further else said
        return InputError(said) if status == 2 else RankError(said)

    def close(self) -> None:
        self._ending = True
        with self._lock:  # no interrupt is on its way any more
            self._ended.set()
        for line in self._lines:
            line.close()
        if self._in_main:
            signal.signal(_INTERRUPT, self._handler or signal.SIG_DFL)

    def _lost(self, line: _Line, how: str) -> None:
        self._stop(f"rank {line.rank} {how} before the work was done", 1)

    def _stop(self, said: str, status: int) -> None:
        """Another rank failed: interrupt the computation here, and end the process if that does not."""
        with self._lock:
            if self._ended.is_set() or self._done.is_set() or self._failure is not None:
                return
            self._failure = said, status
            if self._in_main:
                signal.pthread_kill(threading.main_thread().ident or 0, _INTERRUPT)
                threading.Thread(target=self._end_late, daemon=True).start()

    def _interrupted(self, *_: object) -> None:
        """In the main thread, on `_INTERRUPT`."""
        if not self._ending:
            raise KeyboardInterrupt

    def _end_late(self) -> None:
        if self._ended.wait(GRACE) or self._failure is None:
            return
        said, status = self._failure
        self._send_all(_FAILED, f"{status}{said}".encode())
        print(f"jaxpanda: {printable(said)}", file=sys.stderr, flush=True)
        os._exit(status)


def _listening(host: str, port: int, backlog: int) -> socket.socket:
    """At an address as given; for a name, which may mean the loopback to its own machine, at all."""
    if host == "localhost" or re.fullmatch(r"[\d.]+|.*:.*", host):
        family = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0][0]
        return socket.create_server((host, port), family=family, backlog=backlog)
    if socket.has_dualstack_ipv6():
        return socket.create_server(("", port), family=socket.AF_INET6, backlog=backlog, dualstack_ipv6=True)
    return socket.create_server(("", port), backlog=backlog)


def _packed(arrays: Sequence[np.ndarray]) -> bytes:
    """Arrays as bytes, their shapes before them; numbers and truth values only."""
    parts = [np.ascontiguousarray(one) for one in arrays]
    head = json.dumps(
        [[one.dtype.str, np.shape(given)] for one, given in zip(parts, arrays, strict=True)]
    ).encode()
    return b"".join([struct.pack("<Q", len(head)), head, *(one.tobytes() for one in parts)])


def _unpacked(content: bytes) -> list[np.ndarray]:
    (size,) = struct.unpack_from("<Q", content)
    at, found = 8 + size, []
    for kind, shape in json.loads(content[8:at]):
        dtype = np.dtype(kind)
        number = int(np.prod(shape))
        found.append(np.frombuffer(content, dtype, number, at).reshape(shape))
        at += number * dtype.itemsize
    return found
