"""SIGINT, SIGTERM and SIGHUP end a command alike, whenever they come; in somebody else's process they do what they did.

What a run keeps, and how it goes on, is tested in `test_resume`.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from contextlib import contextmanager
from pathlib import Path

import psutil
import pytest

from interrupted_runs import STOPS_WITHIN_S, children_of, wait_until
from places import SUPPORT
from zlocus.cli.app import app
from zlocus.cli.commands import command_of
from zlocus.cli.config import ConfigOptions, config
from zlocus.core.requests import DEMO_BEGUN
from zlocus.core.signals import ENDING
from zlocus.pipeline.execution import precompile as warm

# Signals do what they do in a process that was not started to ignore them.
HEARS = """
import signal
for number in (signal.SIGTERM, signal.SIGHUP):
    signal.signal(number, signal.SIG_DFL)
signal.signal(signal.SIGINT, signal.default_int_handler)
"""
# A command of its own, in which things happen.
PROGRAM = """
import atexit, os, signal, subprocess, sys, time
import typer
from zlocus.core import signals
from zlocus.cli.exit_status import explained

def send(number):
    os.kill(os.getpid(), number)
    time.sleep(0.1)

app = typer.Typer()

@app.command()
@explained
def command():
{body}

signals.handle_signals()
{before}
app()
"""


def program(body: str, before: str = "", first: str = "") -> list[str]:
    lines = "\n".join(f"    {line}" for line in body.strip().splitlines())
    return [sys.executable, "-c", HEARS + first + PROGRAM.format(body=lines, before=before)]


@contextmanager
def started(words, **more):
    """A process in a session of its own."""
    environment = {key: value for key, value in os.environ.items() if key != "PYTHONUNBUFFERED"}
    environment |= more.pop("env", {})
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE} | more
    with subprocess.Popen(words, env=environment, text=True, start_new_session=True, **pipes) as process:
        try:
            yield process
        finally:
            process.kill()


def ended(words) -> tuple[int, str, str]:
    """Exit status and output of a process that ends soon."""
    with started(words) as process:
        out, error = process.communicate(timeout=6 * STOPS_WITHIN_S)
        return process.returncode, out, error


def is_deaf(process) -> bool:
    """Whether a process hears none of the signals that end a command."""
    status = dict(line.split(":", 1) for line in Path(f"/proc/{process.pid}/status").read_text().splitlines())
    return all(int(status["SigBlk"], 16) >> number - 1 & 1 for number in ENDING)


def assert_gone(processes):
    _, alive = psutil.wait_procs(processes, STOPS_WITHIN_S)
    assert not [one for one in alive if one.status() != psutil.STATUS_ZOMBIE]


@pytest.mark.parametrize(
    ("name", "status", "says"),
    [("SIGINT", 130, "Interrupted."), ("SIGTERM", 143, "Ended by SIGTERM."), ("SIGHUP", 129, "Ended by SIGHUP.")],
)
def test_each_signal_has_its_sentence_and_its_status(name, status, says):
    assert ended(program(f"send(signal.{name})")) == (status, "", f"zlocus: {says}\n")


ENDED = (143, "", "zlocus: Ended by SIGTERM.\n")
# What happens in a command, by what it is called.
HAPPENS = {
    "in a finaliser, where Python swallows exceptions": """
class Closed:
    def __del__(self):
        send(signal.SIGTERM)
Closed()
time.sleep(60)
""",
    "in code that swallows everything, and once more": """
try:
    send(signal.SIGTERM)
except:
    pass
send(signal.SIGTERM)
time.sleep(60)
""",
    "with another error as its consequence": """
try:
    send(signal.SIGTERM)
except KeyboardInterrupt:
    raise OSError(5, "Input/output error")
""",
    "and is then told by somebody else": """
try:
    send(signal.SIGTERM)
except KeyboardInterrupt as error:
    raise RuntimeError("interrupted") from error
""",
}


@pytest.mark.parametrize("what", HAPPENS)
def test_a_signal_ends_the_command(what):
    assert ended(program(HAPPENS[what])) == ENDED


def test_what_tidies_up_is_not_disturbed():
    body = """
try:
    send(signal.SIGTERM)
finally:
    send(signal.SIGHUP)
    send(signal.SIGINT)
    print("tidy")
"""
    assert ended(program(body)) == (143, "tidy\n", "zlocus: Ended by SIGTERM.\n")


def test_what_tidies_up_for_too_long_is_cut_short():
    """By another signal; what was printed is not lost."""
    body = """
signals.TIDYING_S = 0.1
print("begun")
try:
    send(signal.SIGTERM)
finally:
    time.sleep(0.2)
    send(signal.SIGINT)
    time.sleep(60)
"""
    assert ended(program(body)) == (143, "begun\n", "zlocus: Ended by SIGTERM.\n")


def test_before_and_after_the_command():
    """Nothing is half-done then: the process ends at once, with what it has said; at the very end signals are late."""
    assert ended(program("pass", before="send(signal.SIGTERM)")) == ENDED
    at_exit = "import atexit, os; atexit.register(lambda: os.kill(os.getpid(), signal.SIGHUP))\n"
    after = program("print('done')", before=at_exit)
    assert ended(after) == (129, "done\n", "zlocus: Ended by SIGHUP.\n")
    # Registered before the handlers, and so called after all of them.
    late = program("print('done')", first=at_exit)
    assert ended(late) == (0, "done\n", "")


def test_what_was_ignored_at_the_start_stays_ignored():
    """As SIGHUP is below nohup."""
    body = "send(signal.SIGHUP)\nprint('went on')\nsend(signal.SIGTERM)"
    words = program(body, first="signal.signal(signal.SIGHUP, signal.SIG_IGN)\n")
    assert ended(words) == (143, "went on\n", "zlocus: Ended by SIGTERM.\n")


def test_a_terminal_that_hangs_up():
    """What is said to it fails; nobody is shown a trace, and the status is that of the signal."""
    terminal, theirs = os.openpty()
    mine = "import fcntl, termios; fcntl.ioctl(0, termios.TIOCSCTTY, 0)\n"
    words = program("for _ in range(600):\n    print('here', file=sys.stderr)\n    time.sleep(0.1)", first=mine)
    with started(words, stdin=theirs, stdout=theirs, stderr=theirs) as process:
        os.close(theirs)
        assert os.read(terminal, 4) == b"here"
        os.close(terminal)
        assert process.wait(STOPS_WITHIN_S) == 129


def test_processes_below_go_too_but_no_browser():
    body = """
for apart in (False, True):
    words = [sys.executable, "-c", "import time; time.sleep(60)"]
    child = subprocess.Popen(words, start_new_session=apart, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    print(child.pid, flush=True)
send(signal.SIGTERM)
"""
    status, out, _ = ended(program(body))
    assert status == 143
    mine, browser = map(int, out.split())
    assert not psutil.pid_exists(mine) or psutil.Process(mine).status() == psutil.STATUS_ZOMBIE
    os.kill(browser, signal.SIGKILL)  # fails where it is gone


def test_every_command_ends_this_way():
    wrapped = command_of("config", ConfigOptions, config).__code__
    apps = [app, *(group.typer_instance for group in app.registered_groups)]
    commands = {
        one.name or one.callback.__name__: one.callback.__code__ is wrapped
        for each in apps
        for one in each.registered_commands
    }
    assert len(commands) > 10
    assert all(commands.values()), commands


def test_the_python_interface_leaves_signals_alone():
    code = """
import signal, sys, zlocus
zlocus.match
found = [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)]
assert found == [signal.default_int_handler, signal.SIG_DFL, signal.SIG_DFL], found
assert sys.unraisablehook is sys.__unraisablehook__
"""
    assert ended([sys.executable, "-c", HEARS + code]) == (0, "", "")


# A command whose workers are at work for a minute. They find what is imported here, and `worker_tasks`.
WORKERS = """
sys.path.insert(0, {tests!r})
from worker_tasks import Sleeping
from zlocus.pipeline.execution.tasks import run_tasks
from zlocus.pipeline.execution.processes import Processes
with Processes(Sleeping(60.0), 2) as workers:
    run = run_tasks(workers, range(2))
    print("here", flush=True)
    print(next(run))
"""


@pytest.mark.parametrize(
    ("number", "whole_group", "are_working"),
    [(signal.SIGINT, True, False), (signal.SIGTERM, True, True), (signal.SIGHUP, False, False)],
)
def test_workers_say_nothing_and_end_with_the_command(number, whole_group, are_working):
    """Those that work, and those that are still being started."""
    with started(program(WORKERS.format(tests=str(SUPPORT)))) as process:
        assert process.stdout.readline() == "here\n"
        # What starts them, what watches what they share, and themselves.
        wait_until(lambda: len(children_of(process.pid)) >= (4 if are_working else 2))
        children = children_of(process.pid)
        if not are_working:
            assert any(is_deaf(child) for child in children) or sys.platform != "linux"
        (os.killpg if whole_group else os.kill)(process.pid, number)
        out, error = process.communicate(timeout=STOPS_WITHIN_S)
        assert (process.returncode, out) == (128 + number, "")
        assert error.startswith("zlocus: ")
        assert error.count("\n") == 1
        assert_gone(children)


def test_workers_end_when_the_command_is_killed():
    """In the middle of a task: nobody waits for its result."""
    with started(program(WORKERS.format(tests=str(SUPPORT)))) as process:
        wait_until(lambda: len(children_of(process.pid)) >= 4)
        children = children_of(process.pid)
        process.kill()
        assert process.communicate(timeout=STOPS_WITHIN_S)[1] == ""
        assert_gone(children)


def test_a_demo_that_is_ended_while_it_renders(tmp_path):
    """Its kernels are being compiled in processes of their own meanwhile, as none are kept yet."""
    out = tmp_path / "demo"
    code = f"{HEARS}\nfrom zlocus.__main__ import run; run()"
    empty_cache = {"NUMBA_CACHE_DIR": str(tmp_path / "kernels")}
    with started([sys.executable, "-c", code, "demo", "-o", str(out)], env=empty_cache) as process:
        wait_until(lambda: (out / DEMO_BEGUN).exists() and list(out.glob("scene.part/*")))
        children = children_of(process.pid)
        assert len(children) == 3
        process.send_signal(signal.SIGTERM)
        _, error = process.communicate(timeout=STOPS_WITHIN_S)
        told, end = error.splitlines()
        assert told.startswith("Kernels are being compiled, once after an installation")
        assert (process.returncode, end) == (143, "zlocus: Ended by SIGTERM.")
        assert_gone(children)
        assert [path.name for path in out.iterdir()] == [DEMO_BEGUN]


def test_what_compiles_ahead_ends_when_the_command_is_killed():
    code = f"""
import time
from zlocus.pipeline.execution import precompile as warm
warm.warm = lambda group: print("here", flush=True) or time.sleep(60)
{warm.FOR_ANOTHER}
"""
    with started([sys.executable, "-c", code, "match"], stdin=subprocess.PIPE) as process:
        assert process.stdout.readline() == "here\n"
        process.stdin.close()  # as at the end of the process that holds it
        process.wait(STOPS_WITHIN_S)
