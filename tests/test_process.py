"""The process of ``svu``: it ends at once, and yet everything that it owes is done."""

from __future__ import annotations

import gc
import sys

import pytest
from helpers import python

from svu_mi.cli.process import importing

LEAVING = """
import atexit, sys
from svu_mi.cli.process import leave
atexit.register(print, "registered")
class Late:
    def __del__(self):
        print("taken down")
late = Late()
sys.stdout.write("said, ")
leave({status})
"""


@pytest.mark.parametrize("status", [0, 2])
def test_leaving_says_all_and_takes_nothing_down(status):
    done = python("-c", LEAVING.format(status=status))
    assert (done.returncode, done.stdout, done.stderr) == (status, "said, registered\n", "")


def test_what_threads_and_libraries_have_to_say_is_said():
    code = """
import ctypes, threading, time
from svu_mi.cli.process import leave
def late():
    time.sleep(0.2)
    print("from a thread")
ctypes.CDLL(None).printf(b"from C, ")
threading.Thread(target=late).start()
leave(0)
"""
    done = python("-c", code, PYTHONUNBUFFERED="")
    assert (done.returncode, done.stdout) == (0, "from a thread\nfrom C, ")


@pytest.mark.parametrize("stream", ["sys.stdout.close()", "sys.stdout = None"])
def test_where_nobody_listens_the_status_stays(stream):
    code = f"import sys; from svu_mi.cli.process import leave; {stream}; leave(3)"
    done = python("-c", code)
    assert (done.returncode, done.stderr) == (3, "")


def test_modules_are_no_garbage_and_the_rest_is_collected():
    code = """
import gc, sys
from svu_mi.cli.doctor import Doctor
from svu_mi.cli.process import run
def work(self, console):
    first = gc.get_freeze_count()
    self.start()
    print(first > 10_000, gc.get_freeze_count() > first, gc.isenabled())
    return 7
Doctor.run, sys.argv = work, ["svu", "doctor"]
run()
"""
    done = python("-c", code)
    assert (done.returncode, done.stdout) == (7, "True True True\n")


def test_other_processes_are_left_as_they_are():
    before = gc.get_freeze_count()
    with importing():
        assert gc.isenabled()
    assert gc.isenabled() and gc.get_freeze_count() == before


PARTS = """
import ctypes, pathlib
import drjit as dr
import svu_mi
from svu_mi import _workers
core = ctypes.CDLL(str(pathlib.Path(dr.__file__).with_name("libdrjit-core.so")))
size = core._Z19jit_llvm_block_sizev
size.restype = ctypes.c_uint
before = size()
_workers.take_small_parts()
print(before > _workers.PART == size())
_workers.SET_PART = "of another Dr.Jit"
_workers.take_small_parts()
"""


@pytest.mark.skipif(sys.platform != "linux", reason="the function has another name there")
def test_workers_take_small_parts_of_a_launch():
    done = python("-c", PARTS)
    assert (done.returncode, done.stdout) == (0, "True\n"), done.stderr
