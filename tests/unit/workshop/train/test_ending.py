"""How training commands end."""

import os
import signal

import pytest

from appliance.errors import NotFoundError
from workshop.train.ending import Stopping, ended


def test_an_error_is_told_with_its_remedy(capsys: pytest.CaptureFixture[str]) -> None:
    """Without a traceback, and with the exit code of its kind; Ctrl+C ends with 130, success with what was returned."""

    def missing(_: object) -> int:
        raise NotFoundError("there is no run", remedy="begin one")

    def interrupted(_: object) -> int:
        raise KeyboardInterrupt

    assert ended(missing) == NotFoundError.exit_code
    assert capsys.readouterr().err == "error: there is no run\nremedy: begin one\n"
    assert ended(interrupted) == 130
    assert ended(lambda _: 3) == 3


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_asks_to_stop_and_a_second_one_does(number: signal.Signals) -> None:
    """The first is left to the code that looks, between two steps; afterwards signals do what they did before."""
    before = signal.getsignal(number)
    with Stopping() as stopping:
        assert not stopping.asked
        os.kill(os.getpid(), number)
        assert stopping.asked
        with pytest.raises(KeyboardInterrupt):
            os.kill(os.getpid(), number)
    assert signal.getsignal(number) is before
