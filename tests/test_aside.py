"""Drawing aside: in order, in one thread, and what goes wrong there reaches whoever waits."""

from __future__ import annotations

import subprocess
import sys
import threading
from concurrent.futures import wait

import pytest

from svu_mi import aside as module
from svu_mi.aside import drawing_aside, import_aside
from svu_mi.errors import OutputError


def test_work_is_done_in_order_by_one_other_thread():
    done, interval = [], sys.getswitchinterval()
    with drawing_aside() as aside:
        for number in range(20):
            aside(lambda n: done.append((n, threading.get_ident())), number)
        assert aside(lambda: "returned").result() == "returned"
        assert sys.getswitchinterval() < interval
    assert [number for number, _ in done] == list(range(20))
    assert {thread for _, thread in done}.isdisjoint({threading.get_ident()})
    assert len({thread for _, thread in done}) == 1
    assert sys.getswitchinterval() == interval


def fail(words):
    raise OutputError(words)


def test_the_first_error_is_raised_in_the_end():
    done, interval = [], sys.getswitchinterval()
    with pytest.raises(OutputError, match="disk is full"), drawing_aside() as aside:
        done.append("the block")
        aside(fail, "the disk is full")
    assert done == ["the block"] and sys.getswitchinterval() == interval


def test_nothing_is_added_to_what_has_failed():
    done = []
    with pytest.raises(OutputError, match="disk is full"), drawing_aside() as aside:
        wait([aside(fail, "the disk is full")])
        aside(done.append, "more")
    assert not done


def test_where_the_block_fails_nothing_more_is_begun():
    done, begun, go = [], threading.Event(), threading.Event()

    def slow():
        begun.set()
        go.wait(10)
        done.append("slow")

    with pytest.raises(KeyboardInterrupt), drawing_aside() as aside:
        aside(slow)
        aside(done.append, "next")
        begun.wait(10)
        threading.Timer(0.05, go.set).start()
        raise KeyboardInterrupt
    assert done == ["slow"]


def test_what_cannot_be_imported_ahead_is_left_to_whoever_needs_it(monkeypatch, capfd):
    name, interval = "email.mime.image", sys.getswitchinterval()
    for each in (name, "email.mime.audio"):
        monkeypatch.delitem(sys.modules, each, raising=False)
    before = threading.enumerate()
    import_aside(name, "no.such.module", "email.mime.audio")
    for thread in set(threading.enumerate()) - set(before):
        thread.join(10)
    assert name in sys.modules and "email.mime.audio" not in sys.modules
    assert sys.getswitchinterval() == interval and capfd.readouterr().err == ""


def test_turns_are_short_until_the_last_is_done(monkeypatch):
    interval, go, begun = sys.getswitchinterval(), threading.Event(), threading.Event()

    def slow(_):
        begun.set()
        go.wait(10)

    monkeypatch.setattr(module, "import_module", slow)
    before = threading.enumerate()
    import_aside("slow")
    assert begun.wait(10)
    with drawing_aside():
        pass
    assert sys.getswitchinterval() < interval
    go.set()
    for thread in set(threading.enumerate()) - set(before):
        thread.join(10)
    assert sys.getswitchinterval() == interval


def test_what_is_imported_aside_is_imported_by_nothing_of_ours_before():
    code = (
        "import sys, mitsuba as mi\n"
        "mi.set_variant('llvm_ad_rgb')\n"
        "import svu_mi.cli.main, svu_mi.recovery.recover, svu_mi.output.recovery\n"
        "from svu_mi.aside import DRAWING, SCIENCE\n"
        "print(sorted({*SCIENCE, *DRAWING} & set(sys.modules)))\n"
    )
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert found.stdout == "[]\n"
