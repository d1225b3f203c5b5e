"""The end of a command that is told to end: by SIGTERM (``kill``, a scheduler) or by SIGINT (Ctrl-C).

The signal becomes an exception, on whose way out everything that is open is closed. That takes too long where the main
thread is in a long call of compiled code, and never happens where a library swallows the exception. So a thread, which
hears of the signal at once, says that the process ends and after ``LIMIT`` seconds ends it.
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
"""Seconds for the main thread to end by the exception, before its last acts are done in its place."""
LIMIT = 1.7
"""Seconds after which the process has ended."""
_LINE = "neural-sim: ended by {}; the same command goes on with the results that are in the store\n"
_last_acts: list[Callable[[Interrupted], object]] = []


class Interrupted(SystemExit):
    """The command was told to end. Its code is the exit status, 128 and the signal's number, as shells have it."""

    def __init__(self, signum: int) -> None:
        self.status = 128 + signum
        super().__init__(self.status)
        self._name = signal.Signals(signum).name

    @override
    def __str__(self) -> str:
        return self._name


@contextmanager
def last_act(act: Callable[[Interrupted], object]) -> Iterator[None]:
    """Have ``act`` called by another thread if the process must end before what is inside has ended by itself."""
    _last_acts.append(act)
    try:
        yield
    finally:
        _last_acts.remove(act)


@contextmanager
def interruptible() -> Iterator[None]:
    """Let SIGTERM and Ctrl-C end the process within two seconds, with status 143 and 130 and one line.

    A signal that the process was started to ignore stays ignored, as Ctrl-C is by jobs in a shell's background.
    """
    ending = _Ending()
    reading, writing = os.pipe()
    os.set_blocking(writing, False)
    thread = threading.Thread(target=ending.watch, args=(reading,), daemon=True, name="interruption")
    thread.start()
    wakeup = signal.set_wakeup_fd(writing, warn_on_full_buffer=False)
    taken = [signum for signum in SIGNALS if signal.getsignal(signum) != signal.SIG_IGN]
    before = {signum: signal.signal(signum, ending.interrupt) for signum in taken}
    try:
        yield
    finally:
        if ending.error is not None:
            ending.told.wait(LIMIT)
            _flush()
            # At once: with all libraries loaded Python takes seconds to end, in which no thread runs.
            os._exit(ending.error.status)
        for signum, handler in before.items():
            signal.signal(signum, handler)
        signal.set_wakeup_fd(wakeup)
        os.write(writing, b"\0")
        thread.join()
        os.close(reading)
        os.close(writing)


@contextmanager
def signals_kept() -> Iterator[None]:
    """Take signals back from a library that is imported inside and handles them in compiled code.

    pycolmap's logging does: at SIGTERM it prints a stack from within the signal, which can wait for ever for the lock
    of an allocation that the signal interrupted.
    """
    before = {signum: signal.getsignal(signum) for signum in SIGNALS}
    try:
        yield
    finally:
        if threading.current_thread() is threading.main_thread():
            for signum, handler in before.items():
                if handler is not None:  # None: set by compiled code before, and unknown to Python
                    signal.signal(signum, handler)


@contextmanager
def ctrl_c_as_exception() -> Iterator[None]:
    """Let Ctrl-C raise KeyboardInterrupt, for what it ends in the ordinary way."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


def this_process() -> str:
    """Return a name of this process that no other one ever has: its host and boot, namespace, number and start."""
    return f"{_machine()} {_namespace()} {os.getpid()} {_start_of(os.getpid())}"


def has_ended(process: str) -> bool:
    """Tell whether the process of a ``this_process`` has ended; False where this one cannot know."""
    try:
        machine, namespace, pid, start = process.split(" ")
    except ValueError:
        return False
    if not start or machine.partition("/")[0] != platform.node():
        return False
    if machine != _machine():  # the host has started again since
        return True
    return namespace == _namespace() and _start_of(int(pid)) != start


def _machine() -> str:
    with suppress(OSError):
        return f"{platform.node()}/{Path('/proc/sys/kernel/random/boot_id').read_text().strip()}"
    return f"{platform.node()}/"


def _namespace() -> str:
    """Return in which count of processes numbers are: containers of one host have their own."""
    with suppress(OSError):
        return os.readlink("/proc/self/ns/pid")
    return ""


def _start_of(pid: int) -> str:
    """Return when a process began, in ticks since the boot; empty where there is none, or no /proc."""
    with suppress(OSError, IndexError):
        # The name, in parentheses, may have spaces; the start is the 20th field after it (proc(5)).
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[19]
    return ""


class _Ending:
    """The end of a command at its first signal; later ones change nothing."""

    def __init__(self) -> None:
        self.error: Interrupted | None = None
        self.told = threading.Event()

    def interrupt(self, signum: int, _: FrameType | None) -> None:
        """Raise, in the main thread, as soon as it is in Python code."""
        if self.error is None:
            self.error = Interrupted(signum)
            raise self.error

    def watch(self, descriptor: int) -> None:
        """Wait for the first signal, say so, and end the process in time if it has not ended by then."""
        signum = 0
        while signum not in SIGNALS or signal.getsignal(signum) is signal.default_int_handler:
            signum = os.read(descriptor, 1)[0]
            if signum == 0:
                return
        error = Interrupted(signum)
        with suppress(OSError):
            os.write(2, _LINE.format(error).encode())
        self.told.set()
        time.sleep(UNWINDING)
        acts = threading.Thread(target=_do_last_acts, args=(error,), daemon=True)
        acts.start()
        acts.join(LIMIT - UNWINDING)
        os._exit(error.status)


def _do_last_acts(error: Interrupted) -> None:
    for act in reversed(list(_last_acts)):
        with suppress(Exception):
            act(error)
    _flush()


def _flush() -> None:
    for stream in (sys.stdout, sys.stderr):
        with suppress(Exception):
            stream.flush()
