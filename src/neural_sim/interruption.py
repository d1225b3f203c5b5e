"""End a command within two seconds of SIGTERM (``kill``, a scheduler) or SIGINT (Ctrl-C).

The signal becomes an exception in the main thread, which closes everything that is open. That takes too long during a
long call of compiled code, and never happens if a library swallows the exception. So a second thread, which is told of
the signal at once, prints a line and ends the process after ``LIMIT`` seconds.
"""

from __future__ import annotations

import os
import platform
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from types import FrameType

from typing_extensions import override

SIGNALS = (signal.SIGTERM, signal.SIGINT)
UNWINDING = 1.2
"""Seconds that the main thread has to end by the exception, before another thread calls the last acts."""
LIMIT = 1.7
"""Seconds after which the process is ended."""
_LINE = "neural-sim: ended by {}; the same command resumes from the results in the store\n"
_last_acts: list[Callable[[Interrupted], object]] = []
_wakeup: int | None = None
"""Descriptor of the pipe that tells the second thread of signals in order; None outside ``interruptible``."""
# What else is written there, in bytes that are no signal's number.
_CLOSED, _CTRL_C_TAKEN, _CTRL_C_BACK, _RAISED = 0, 100, 101, 128


class Interrupted(SystemExit):
    """The command was told to end. Its code is the exit status, 128 plus the signal's number, as in shells."""

    def __init__(self, signum: int) -> None:
        self.status = 128 + signum
        super().__init__(self.status)
        self._name = signal.Signals(signum).name

    @override
    def __str__(self) -> str:
        return self._name


@contextmanager
def last_act(act: Callable[[Interrupted], object]) -> Iterator[None]:
    """Call ``act`` from another thread if the process must end while this context is still open."""
    _last_acts.append(act)
    try:
        yield
    finally:
        _last_acts.remove(act)


@contextmanager
def interruptible() -> Iterator[None]:
    """Let SIGTERM and Ctrl-C end the process within two seconds, with one line and status 143 or 130.

    A signal that was ignored when the process started stays ignored, such as Ctrl-C in background jobs of a shell.
    """
    global _wakeup
    ending, outer = _Ending(), _wakeup
    reading, writing = os.pipe()
    os.set_blocking(writing, False)
    _wakeup = writing
    thread = threading.Thread(target=ending.watch, args=(reading,), daemon=True, name="interruption")
    thread.start()
    wakeup = signal.set_wakeup_fd(writing, warn_on_full_buffer=False)
    taken = [signum for signum in SIGNALS if signal.getsignal(signum) != signal.SIG_IGN]
    before = {signum: signal.signal(signum, ending.interrupt) for signum in taken}
    try:
        yield
    finally:
        if ending.error is not None:
            ending.reported.wait(LIMIT)
            _flush()
            # Without Python's own exit: with all libraries loaded it takes seconds, in which no thread runs.
            os._exit(ending.error.status)
        for signum, handler in before.items():
            signal.signal(signum, handler)
        signal.set_wakeup_fd(wakeup)
        _wakeup = outer
        os.write(writing, bytes([_CLOSED]))
        thread.join()
        os.close(reading)
        os.close(writing)


@contextmanager
def signals_kept() -> Iterator[None]:
    """Restore the signal handlers that the import of a library inside this context replaces by compiled ones.

    pycolmap's logging does so: its handler of SIGTERM prints a stack trace, which can wait forever for the lock of an
    allocation that the signal interrupted.
    """
    before = {signum: signal.getsignal(signum) for signum in SIGNALS}
    try:
        yield
    finally:
        if threading.current_thread() is threading.main_thread():
            for signum, handler in before.items():
                if handler is not None:  # None: compiled code had set it before, and Python does not know it
                    signal.signal(signum, handler)


@contextmanager
def ctrl_c_as_exception() -> Iterator[None]:
    """Let Ctrl-C raise KeyboardInterrupt inside this context, for work that it is meant to end."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    # The second thread may read a signal late, so the pipe's order says which ones came in this context.
    _write(_CTRL_C_TAKEN)
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        yield
    finally:
        try:
            signal.signal(signal.SIGINT, before)
        finally:  # once more, because a second Ctrl-C is raised in its place
            signal.signal(signal.SIGINT, before)
            _write(_CTRL_C_BACK)


def this_process() -> str:
    """Return a name that no other process ever has: host and boot, namespace, process number and start time."""
    return f"{_machine()} {_namespace()} {os.getpid()} {_start_of(os.getpid())}"


def has_ended(process: str) -> bool:
    """Return whether the process with this name (see ``this_process``) has ended; False if that cannot be known."""
    try:
        machine, namespace, pid, start = process.split(" ")
    except ValueError:
        return False
    if not start or machine.partition("/")[0] != platform.node():
        return False
    if machine != _machine():  # the host has rebooted since
        return True
    return namespace == _namespace() and _start_of(int(pid)) != start


def _machine() -> str:
    with suppress(OSError):
        return f"{platform.node()}/{Path('/proc/sys/kernel/random/boot_id').read_text().strip()}"
    return f"{platform.node()}/"


def _namespace() -> str:
    """Return the namespace of process numbers: containers on one host have their own."""
    with suppress(OSError):
        return os.readlink("/proc/self/ns/pid")
    return ""


def _start_of(pid: int) -> str:
    """Return when a process started, in ticks since the boot; empty if there is no such process, or no /proc."""
    with suppress(OSError, IndexError):
        # The name, in parentheses, may have spaces; the start is the 20th field after it (proc(5)).
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[19]
    return ""


class _Ending:
    """Ends a command at its first signal; later signals change nothing."""

    def __init__(self) -> None:
        self.error: Interrupted | None = None
        self.reported = threading.Event()

    def interrupt(self, signum: int, _: FrameType | None) -> None:
        """Raise in the main thread. As a signal handler, it runs as soon as that thread executes Python code."""
        if self.error is None:
            self.error = Interrupted(signum)
            _write(_RAISED + signum)
            raise self.error

    def watch(self, descriptor: int) -> None:
        """Wait for the first signal, report it, and end the process if it has not ended in time."""
        signum, taken = 0, 0
        while signum not in SIGNALS or (signum == signal.SIGINT and taken > 0):
            signum = os.read(descriptor, 1)[0]
            if signum == _CLOSED:
                return
            taken += (signum == _CTRL_C_TAKEN) - (signum == _CTRL_C_BACK)
            if signum > _RAISED:
                signum, taken = signum - _RAISED, 0
        error = Interrupted(signum)
        with suppress(OSError):
            os.write(2, _LINE.format(error).encode())
        self.reported.set()
        time.sleep(UNWINDING)
        acts = threading.Thread(target=_do_last_acts, args=(error,), daemon=True)
        acts.start()
        acts.join(LIMIT - UNWINDING)
        os._exit(error.status)


def _write(byte: int) -> None:
    if _wakeup is not None:
        with suppress(BlockingIOError):
            os.write(_wakeup, bytes([byte]))


def _do_last_acts(error: Interrupted) -> None:
    for act in reversed(list(_last_acts)):
        with suppress(Exception):
            act(error)
    _flush()


def _flush() -> None:
    for stream in (sys.stdout, sys.stderr):
        with suppress(Exception):
            stream.flush()
