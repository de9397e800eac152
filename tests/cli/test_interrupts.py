"""Ctrl-C ends the program `gsseg` with exit code 130, in silence, whatever it is doing; SIGTERM and SIGHUP likewise."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from patience import PATIENCE
from segmented_place import contents, segment

from gsseg_core.cli.main import main
from gsseg_core.learn.vote_learner import VoteLearner

# Like `bin/gsseg`. A finder that finds nothing counts imports, and interrupts a copy of the process at every so many.
COPIES = """
import os, signal, sys, warnings
warnings.simplefilter("ignore", DeprecationWarning)  # Newer Pythons warn of copies of processes with threads.
every = int(sys.argv.pop(1))
class Interrupter:
    count, codes = 0, {}
    def find_spec(self, name, path=None, target=None):
        Interrupter.count += 1
        if Interrupter.count % every or "gsseg_core.cli.interrupts" not in sys.modules:
            return
        copy = os.fork()
        if copy == 0:
            sys.meta_path.remove(self)
            signal.alarm(1200)
            os.kill(os.getpid(), signal.SIGINT)
        else:
            Interrupter.codes[name] = os.waitstatus_to_exitcode(os.waitpid(copy, 0)[1])
process = os.getpid()
from gsseg_core.cli.main import main
sys.meta_path.insert(0, Interrupter())
try:
    sys.exit(main())
finally:
    if os.getpid() == process:
        print(len(Interrupter.codes), {name: code for name, code in Interrupter.codes.items() if code != 130})
"""

# The command `gsseg doctor` does `work` instead.
AT_WORK = """
import atexit, ctypes, os, signal, sys
def interrupt():
    os.kill(os.getpid(), signal.SIGINT)
def work(options):
{work}
from gsseg_core.cli import doctor as cli_doctor
cli_doctor.run, sys.argv = work, ["gsseg", "doctor"]
from gsseg_core.cli.main import main
sys.exit(main())
"""


def run(program: str, *arguments: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-c", program, *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=False, timeout=PATIENCE)


@pytest.mark.parametrize(
    ("every", "arguments", "told"),
    [(1, ["completion", "bash"], ""), (113, ["segment", "no.ply", "--data", "no", "--out", "no", "--quiet"], "no.ply")],
)
def test_ctrl_c_at_any_import_ends_with_130_and_not_a_word(every: int, arguments: list[str], told: str) -> None:
    done = run(COPIES, str(every), *arguments)
    count, wrong = done.stdout.splitlines()[-1].split(" ", 1)
    assert wrong == "{}" and int(count) >= 5, done.stderr
    assert done.stderr.count("\n") == bool(told) and told in done.stderr, done.stderr


@pytest.mark.parametrize(
    ("work", "code"),
    [("interrupt()", 130),
     ("ctypes.CFUNCTYPE(None)(interrupt)(); import time; time.sleep(3600)", 130),
     ("try: interrupt()\n    except KeyboardInterrupt: raise RuntimeError('cancelled')", 130),
     ("try: interrupt()\n    finally: interrupt()", 130),
     ("atexit.register(interrupt); return 0", 130),
     ("signal.signal(signal.SIGINT, signal.SIG_IGN); interrupt(); return 7", 7)],
)  # fmt: skip
def test_an_interrupt_is_not_lost_and_not_printed_wherever_it_is_raised(work: str, code: int) -> None:
    done = run(AT_WORK.replace("{work}", f"    {work}"))
    assert (done.returncode, done.stdout, done.stderr) == (code, "", "")


@pytest.mark.parametrize("name", ["SIGINT", "SIGHUP"])
def test_a_job_in_the_background_stays_deaf_to_what_is_typed_and_one_of_nohup_to_the_end_of_its_terminal(
    name: str,
) -> None:
    program = f"import signal; signal.signal(signal.{name}, signal.SIG_IGN)\n" + AT_WORK
    done = run(program.replace("{work}", f"    os.kill(os.getpid(), signal.{name}); return 7"))
    assert (done.returncode, done.stderr) == (7, "")


def test_ctrl_c_while_kernels_compile_ends_with_130_and_not_a_word(tmp_path: Path) -> None:
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)}
    command = [sys.executable, "-m", "gsseg_core.cli", "doctor"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, env=environment) as process:
        assert process.stdout is not None and process.stderr is not None
        assert b"compiling kernels" in process.stderr.readline()
        process.send_signal(signal.SIGINT)
        assert process.communicate(timeout=PATIENCE) == (b"", b"")
    assert process.returncode == 130


def test_an_interrupt_while_learning_ends_with_130_and_changes_nothing(
    place: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    before = contents(place / "out")

    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(VoteLearner, "fit", interrupted)
    assert main(segment(place, "--learner", "votes")) == 130
    assert capsys.readouterr().err == ""
    assert contents(place / "out") == before


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_in_a_real_process_ends_it_without_a_traceback_and_leaves_nothing_behind(
    place: Path, number: signal.Signals
) -> None:
    before = contents(place / "out")
    # The learner waits, so that the signal meets it at work; the warm-up, which tells nobody, goes on. A test run by
    # `nohup` is deaf to SIGHUP, and what it starts would be, too.
    program = (
        "import signal, sys, time\nsignal.signal(signal.SIGHUP, signal.SIG_DFL)\nfrom gsseg_core.cli.main import main\n"
        "from gsseg_core.learn.vote_learner import VoteLearner\n"
        "def fit(self, progress=None):\n"
        "    if progress: progress('learn', 0, 9); print('at work', file=sys.stderr); time.sleep(3600)\n"
        "VoteLearner.fit = fit\n"
        "sys.exit(main())"
    )
    arguments = [option for option in segment(place, "--learner", "votes") if option != "--quiet"]
    with subprocess.Popen(
        [sys.executable, "-c", program, *arguments], stderr=subprocess.PIPE, stdout=subprocess.DEVNULL
    ) as process:
        assert process.stderr is not None
        stderr = b""
        while b"at work" not in stderr and process.poll() is None:
            stderr += os.read(process.stderr.fileno(), 4096)
        process.send_signal(number)
        stderr += process.stderr.read()
    assert process.returncode == 128 + number, stderr
    assert b"Traceback" not in stderr and b"gsseg" not in stderr and stderr.endswith(b"\n")
    assert contents(place / "out") == before
