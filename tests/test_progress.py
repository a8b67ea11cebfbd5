"""What a long job shows: a bar on terminals, a line now and then elsewhere, nothing where it is quick."""

import io
import logging

import pytest
from rich.console import Console

from tidefield import progress as module
from tidefield.progress import ProgressBar


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """Seconds that tests let pass."""
    now = [100.0]
    monkeypatch.setattr(module, "monotonic", lambda: now[0])
    return now


@pytest.fixture(autouse=True)
def messages_are_heard(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO, logger="tidefield")


def file_or_terminal(terminal: bool) -> tuple[Console, io.StringIO]:
    file = io.StringIO()
    return Console(file=file, force_terminal=terminal, width=100), file


def work(console: Console, clock: list[float], pieces: int, seconds: float) -> None:
    with ProgressBar(console, "Rendering") as meter:
        for done in range(1, pieces + 1):
            clock[0] += seconds
            meter(done, pieces)


def test_a_file_gets_a_line_now_and_then_and_one_at_the_end(clock: list[float], caplog: pytest.LogCaptureFixture):
    console, file = file_or_terminal(False)
    work(console, clock, pieces=10, seconds=4)
    assert caplog.messages == [
        "Rendering: 3 of 10  0:28 left",
        "Rendering: 6 of 10  0:16 left",
        "Rendering: 9 of 10  0:04 left",
        "Rendering: 10 of 10",
    ]
    assert file.getvalue() == ""


def test_a_quick_job_leaves_no_line(clock: list[float], caplog: pytest.LogCaptureFixture):
    console, file = file_or_terminal(False)
    work(console, clock, pieces=9, seconds=1)
    assert caplog.messages == []
    assert file.getvalue() == ""


def test_a_terminal_gets_a_bar_that_goes_away_and_no_lines(clock: list[float], caplog: pytest.LogCaptureFixture):
    console, file = file_or_terminal(True)
    work(console, clock, pieces=10, seconds=60)
    shown = file.getvalue()
    assert "Rendering" in shown
    assert "10 of 10" in shown
    assert shown.endswith("\x1b[2K"), "the bar's line is erased"
    assert caplog.messages == []


@pytest.mark.parametrize("terminal", [True, False])
def test_a_quiet_console_shows_nothing(terminal: bool, clock: list[float], caplog: pytest.LogCaptureFixture):
    file = io.StringIO()
    work(Console(file=file, force_terminal=terminal, quiet=True), clock, pieces=10, seconds=60)
    assert file.getvalue() == ""
    assert caplog.messages == []


def test_no_colour_is_shown_to_those_who_want_none(clock: list[float], monkeypatch: pytest.MonkeyPatch):
    def colours() -> bool:
        console, file = file_or_terminal(True)
        work(console, clock, pieces=2, seconds=1)
        return "\x1b[38" in file.getvalue() or "\x1b[3" in file.getvalue().replace("\x1b[39", "")

    monkeypatch.setenv("TERM", "xterm-256color")
    monkeypatch.delenv("NO_COLOR", raising=False)
    assert colours()
    monkeypatch.setenv("NO_COLOR", "1")
    assert not colours()


def test_time_left_is_judged_by_what_this_process_did(clock: list[float], caplog: pytest.LogCaptureFixture):
    with ProgressBar(file_or_terminal(False)[0], "Training") as meter:
        for share in (0.5, 0.6, 0.7):
            clock[0] += 11
            meter(share, 1, f"at {share}")
    assert caplog.messages == ["Training: at 0.5", "Training: at 0.6  0:44 left", "Training: at 0.7  0:33 left"]
