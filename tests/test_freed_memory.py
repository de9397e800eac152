"""Programs keep freed memory for the next view, and at their end look through none of it."""

from __future__ import annotations

import subprocess
import sys

import pytest

from gsseg_core.freed_memory import keep_freed_memory

SCRIPT = """
import resource
import numpy as np
from gsseg_core.freed_memory import keep_freed_memory

def pages():
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    for _ in range(8):
        arrays = [np.ones(2_500_000, np.float32) for _ in range(4)]
        del arrays
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before

without = pages()
keep_freed_memory()
pages()
print(without, pages())
"""


def test_what_was_freed_is_used_again_without_asking_the_system() -> None:
    if not keep_freed_memory():
        pytest.skip("the C library is not glibc")
    done = subprocess.run([sys.executable, "-c", SCRIPT], capture_output=True, text=True, check=True)
    without, kept = map(int, done.stdout.split())
    assert kept < without / 4


IN_THREADS = """
import threading
import numpy as np
from gsseg_core.freed_memory import keep_freed_memory

keep_freed_memory()
ended, done = threading.Event(), threading.Semaphore(0)

def work():
    [np.ones(2_500_000, np.float32) for _ in range(4)]
    done.release()
    ended.wait()

def mib():
    return int(open("/proc/self/status").read().split("VmRSS:")[1].split()[0]) / 1024

before = mib()
threads = [threading.Thread(target=work) for _ in range(10)]
for thread in threads:
    thread.start()
    done.acquire()
print(mib() - before)
ended.set()
"""


def test_what_one_thread_has_freed_another_uses_again() -> None:
    if not keep_freed_memory():
        pytest.skip("the C library is not glibc")
    done = subprocess.run([sys.executable, "-c", IN_THREADS], capture_output=True, text=True, check=True)
    assert float(done.stdout) < 160  # MiB; what each of ten threads takes is 38


AT_THE_END = """
import atexit
from gsseg_core.freed_memory import end_without_a_search, search_no_imports_at_the_end

class Circle:
    def __init__(self, name):
        self.itself, self.name = self, name
    def __del__(self):
        print(self.name)

atexit.register(print, "ended")
Circle("early")
{call}
Circle("late")
"""


@pytest.mark.parametrize(
    ("call", "said"),
    [
        ("", "ended early late"),
        ("end_without_a_search()", "ended"),
        ("search_no_imports_at_the_end()", "ended late"),
    ],
)
def test_a_program_that_says_so_ends_without_a_search_for_circles_of_objects(call: str, said: str) -> None:
    done = subprocess.run(
        [sys.executable, "-c", AT_THE_END.format(call=call)], capture_output=True, text=True, check=True
    )
    assert done.stdout.split() == said.split()
