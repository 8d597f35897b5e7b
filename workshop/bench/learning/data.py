"""The data sets of the measurements: stand-ins of a size that makes a difference of half a point mean something.

Of 7,200 items that are judged one standard error is 0.25 points at an accuracy of 0.95. Sites and speakers that are
judged are in no client's data.
"""

from collections.abc import Callable
from pathlib import Path

from appliance.learn.datasets.make import Clips, Speech, make_clips, make_speech
from appliance.skills._lib.learning import loading, partition
from appliance.skills._lib.learning.seeds import seed as derive

CLASSES, TRAIN_SITES, TEST_SITES = 10, 24, 8
TRAIN_SPEAKERS, MOST_TEST_SPEAKERS = 16, 60
TELL_EVERY = 500


def name_of(workload: str, train_items: int, test_items: int) -> str:
    """Return the name of a data set's folder."""
    return f"{workload}-{train_items}-{test_items}"


def make(folder: Path, workload: str, train_items: int, test_items: int, progress: Callable[[str], None]) -> Path:
    """Make a data set where it is not there yet, and return its folder.

    Args:
        folder: of data sets.
        workload: clips or words.
        train_items: about so many for all clients together.
        test_items: at least so many to judge by.
        progress: told how far it is.
    """

    def tell(done: int, total: int) -> None:
        if done % TELL_EVERY == 0 or done == total:
            progress(f"{workload}: {done:,} of {total:,} items are there")

    target = folder / name_of(workload, train_items, test_items)
    target.parent.mkdir(parents=True, exist_ok=True)
    if workload == "clips":
        settings = Clips(
            train_sites=TRAIN_SITES,
            test_sites=TEST_SITES,
            train_clips=_shared(train_items, CLASSES * TRAIN_SITES),
            test_clips=_shared(test_items, CLASSES * TEST_SITES),
        )
        make_clips(target, settings, progress=tell)
    else:
        recordings = _shared(train_items, TRAIN_SPEAKERS)
        speech = Speech(
            kind=workload,
            train_speakers=TRAIN_SPEAKERS,
            test_speakers=min(MOST_TEST_SPEAKERS, _shared(test_items, recordings)),
            recordings=recordings,
        )
        make_speech(target, speech, progress=tell)
    return target


def _shared(items: int, among: int) -> int:
    return max(1, -(-items // among))


def samples(folder: Path, *, by: str, clients: int, seed: int) -> list[int]:
    """Return how many items each client has, as handlers share them out."""
    items = loading.read(folder, "train").items
    parts = partition.split(items, by=by, of=clients, seed=derive(seed, 0, "", "partition"))
    return [len(part) for part in parts]
