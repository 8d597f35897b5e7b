"""Cells of the bench of federated learning: which there are, and how their files are found again."""

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from appliance.errors import ConfigError, RefusedError
from workshop.bench.learning import store
from workshop.bench.learning.cells import KINDS, SIZES, Cell, cells, chosen, client_name, speeds
from workshop.bench.learning.run import alone


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("workload", ["clips", "words"])
def test_each_cell_has_a_name_of_its_own(workload: str, size: str) -> None:
    """Names are those of files: no two cells share one, and each kind is there (Flower for clips alone)."""
    found = cells(workload, size)  # pyright: ignore[reportArgumentType] - the parameters are those of the types
    assert len({cell.name for cell in found}) == len(found)
    kinds = {cell.kind for cell in found}
    assert kinds == set(KINDS) - (set() if workload == "clips" else {"flower"})


def test_cells_are_chosen_by_kind_and_name() -> None:
    """A kind, or the beginning of a name with or without the workload; anything else is refused with what there is."""
    every = cells("clips", "full")
    assert chosen(every, []) == every
    assert {cell.kind for cell in chosen(every, ["wall"])} == {"wall"}
    assert [cell.name for cell in chosen(every, ["restart"])] == ["clips-restart"]
    assert len(chosen(every, ["clips-virtual-sync"])) == len(chosen(every, ["virtual-sync"])) == 3
    with pytest.raises(ConfigError, match="no cell 'wal1'"):
        chosen(every, ["wall", "wal1"])


@given(st.integers(4, 200))
def test_a_quarter_of_the_clients_is_slow(clients: int) -> None:
    """One in eight is five times slower and one in eight three times, at least one of each."""
    slow = speeds(clients)
    assert sorted(slow.values(), reverse=True) == list(slow.values())
    assert list(slow) == [client_name(number) for number in range(len(slow))]
    assert (
        sum(each == 5.0 for each in slow.values()) == sum(each == 3.0 for each in slow.values()) == max(1, clients // 8)
    )
    assert speeds(clients, stragglers=False) == {}


def test_a_result_is_found_again_only_with_its_settings(tmp_path: Path) -> None:
    """A file of other settings, a damaged one or none at all is measured again."""
    cell = Cell(kind="wall", name="clips-wall-sync-8", settings={"clients": 8, "workload": "clips"})
    assert store.read(tmp_path, cell) is None
    kept = store.write(tmp_path, cell, {"p50_s": 1.5}, took_s=2.0, load=(0.1, 0.2))
    assert store.read(tmp_path, cell) == kept
    assert store.read(tmp_path, replace(cell, settings={"workload": "clips", "clients": 8})) == kept
    assert store.read(tmp_path, replace(cell, settings={"clients": 9, "workload": "clips"})) is None
    store.path_of(tmp_path, cell).write_text("{")
    assert store.read(tmp_path, cell) is None


def test_two_benches_do_not_train_in_one_folder(tmp_path: Path) -> None:
    """The second is refused with what to do; once the first has ended it may."""
    first = alone(tmp_path / "out" / "pool")
    with pytest.raises(RefusedError, match=r"another bench trains in .*/out"):
        alone(tmp_path / "out" / "pool")
    first.close()
    alone(tmp_path / "out" / "pool").close()
