"""Files as the specification has them: the mcap library reads what is written here, whatever it is."""

import io
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader

from appliance.record.mcap_writer import McapFile
from appliance.record.reader import info, read

messages = st.lists(st.tuples(st.integers(0, 4), st.integers(1, 2**62), st.binary(max_size=60)), max_size=60)


@settings(deadline=None)
@given(messages, st.sampled_from(["zstd", "lz4", "none"]), st.integers(1, 400), st.integers(0, 59))
def test_the_library_reads_it(
    some: list[tuple[int, int, bytes]], compression: str, chunk_bytes: int, attach_at: int
) -> None:
    """Every message, schema, attachment and metadata record is found by its index, with all checksums right."""
    out = io.BytesIO()
    file = McapFile(out, chunk_bytes=chunk_bytes, compression=compression)
    file.start(profile="p", library="l")
    file.add_metadata("m", {"a": "b"})
    schema = file.register_schema("s", "jsonschema", b"{}")
    channels: dict[int, int] = {}
    for number, (which, at, data) in enumerate(some):
        if which not in channels:
            channels[which] = file.register_channel(f"k/{which}", "json", schema, {"n": str(which)})
        file.add_message(channels[which], at, data, number)
        if number == attach_at:
            file.add_attachment("a.json", "application/json", b"[1]", at_ns=7)
    file.finish()
    out.seek(0)
    reader = make_reader(out, validate_crcs=True)
    summary = reader.get_summary()
    assert summary is not None
    assert summary.statistics is not None
    assert summary.statistics.message_count == len(some)
    found = {
        message.sequence: (channel.topic, message.log_time, message.data)
        for _, channel, message in reader.iter_messages()
    }
    assert found == {number: (f"k/{which}", at, data) for number, (which, at, data) in enumerate(some)}
    assert [each.metadata for each in reader.iter_metadata()] == [{"a": "b"}]
    attached = [each.data for each in reader.iter_attachments()]
    assert attached == ([b"[1]"] if attach_at < len(some) else [])
    if some:
        times = [at for _, at, _ in some]
        assert (summary.statistics.message_start_time, summary.statistics.message_end_time) == (min(times), max(times))


@pytest.mark.parametrize("finished", [True, False])
def test_attachments_are_told_and_cut_files_keep_them(tmp_path: Path, *, finished: bool) -> None:
    """What is attached is named, also by a file that was never finished; its messages are all there."""
    path = tmp_path / "a.mcap"
    with path.open("wb") as out:
        file = McapFile(out, chunk_bytes=1000, compression="zstd")
        file.start(profile="", library="")
        channel = file.register_channel("k", "json", 0, {})
        file.add_message(channel, 1, b"{}")
        file.add_attachment("plan-t1-2.json", "application/json", b"{}", at_ns=1)
        file.add_message(channel, 2, b"{}")
        file.flush()
        if finished:
            file.finish()
    told = info(path)
    assert (told.messages, told.attachments, told.recovered) == (2, ("plan-t1-2.json",), not finished)
    assert [each.at_ns for each in read(path)] == [1, 2]
