"""The collector of cycles while the terminal UI runs."""

import gc

from appliance.process import THRESHOLDS, gentle_collector


def test_what_is_there_is_left_alone_and_cycles_still_go() -> None:
    """The program's own objects are left out of collections, cycles that come later are found, and all is as before."""

    class Ring:
        """Refers to itself."""

        gone = 0

        def __init__(self) -> None:
            self.own = self

        def __del__(self) -> None:
            Ring.gone += 1

    before = gc.get_threshold()
    with gentle_collector():
        assert gc.get_freeze_count() > 1000
        assert gc.get_threshold() == THRESHOLDS
        Ring()
        gc.collect()
        assert Ring.gone == 1
    assert gc.get_threshold() == before
    assert gc.get_freeze_count() == 0
