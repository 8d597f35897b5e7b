"""Signed parts in the pool: an image of another id is not started, an edited skill is neither planned nor loaded."""

import textwrap
from collections.abc import Callable
from pathlib import Path

import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from appliance.identity.parts import ALL, InForce, Parts, seal
from appliance.model import Need, RunEventKind, RunRequest
from appliance.pool.signed import SHARED, skill_parts, without_unsigned
from appliance.skills.catalogue import SKILLS, Catalogue, load_catalogue
from tests.unit.pool.bench import Bench, until

pytestmark = pytest.mark.anyio

MANIFEST = """
id = "NAME"
domain = "media"
summary = "Read."
runs = "compute"
image = "small"
"""
HANDLER = """
def run(ctx):
    return {"said": "hello"}
"""


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """A folder of two skills, with their image."""
    root = tmp_path / "skills"
    for name in ("greet", "wave"):
        (root / name).mkdir(parents=True)
        (root / name / "handler.py").write_text(textwrap.dedent(HANDLER))
        (root / name / "skill.toml").write_text(MANIFEST.replace("NAME", name))
    (root / "images" / "small").mkdir(parents=True)
    (root / "images" / "small" / "image.toml").write_text('name = "small"\npackages = ["python3"]\n')
    return root


@pytest.fixture
def catalogue(root: Path) -> Catalogue:
    """The catalogue of the bench."""
    return load_catalogue([root])


@pytest.fixture
async def sign(bench: Bench, root: Path, tmp_path: Path) -> Callable[..., InForce]:
    """Sign all that there is now; returns what counts for a gateway."""
    key = Ed25519PrivateKey.generate()
    number = iter(range(1, 9))

    async def ids() -> dict[str, tuple[str, ...]]:
        return {each: ((await bench.engine.image(each)).id,) for each in bench.engine.references.values()}

    images = await ids()

    def again(**other: str) -> InForce:
        skills = {name: (digest,) for name, digest in (skill_parts(SKILLS) | skill_parts(root)).items()}
        shared = {name: (skill_parts(SKILLS)[name],) for name in SHARED}
        listed = Parts(
            fleet="f1",
            number=next(number),
            image=images | {bench.engine.references[name]: (each,) for name, each in other.items()},
            skill=skills | shared,
        )
        (tmp_path / "parts.json").write_bytes(seal(listed, key))
        return InForce(tmp_path / "parts.json", authority=key.public_key(), fleet="f1")

    return again


def _request(skill: str) -> RunRequest:
    return RunRequest(task="t", subtask="s", attempt=1, skill=skill, need=Need(image="small", cpu=0.1, memory_mb=64))


async def test_what_is_signed_runs(bench: Bench, sign: Callable[..., InForce]) -> None:
    """Containers are made of the image's id, so that its tag may be given to another meanwhile."""
    pool = await bench.pool(parts=sign())
    last, _ = await bench.run(pool, _request("greet"))
    assert last.result == {"said": "hello"}
    assert {len(spec.image) for spec in bench.engine.specs.values()} == {64}


async def test_a_tag_with_another_id_is_not_started(bench: Bench, sign: Callable[..., InForce]) -> None:
    """The run fails with what is to be signed; it is counted, and nothing was created."""
    counts = sign()
    bench.engine.ids[bench.engine.references["small"]] = "1" * 64
    pool = await bench.pool(parts=counts)
    with pytest.raises(Exception, match="is not signed: it is 111111111111") as caught:
        await bench.run(pool, _request("greet"))
    assert "swiftbot parts sign" in getattr(caught.value, "remedy", "")
    assert pool.refused["unsigned image"] >= 1
    assert not bench.engine.specs
    assert "image localhost/swiftbot/small" in counts.problem


async def test_a_skill_that_was_edited_after_signing_is_not_implemented(
    root: Path, catalogue: Catalogue, sign: Callable[..., InForce]
) -> None:
    """The planner hears of it as of one without a handler; signing it again brings it back."""
    counts = sign()
    (root / "greet" / "handler.py").write_text("import os")
    left = without_unsigned(catalogue, counts)
    assert {name for name, each in left.skills.items() if each.implemented} == {
        name for name, each in catalogue.skills.items() if each.implemented and name != "greet"
    }
    assert counts.problem == "not in the list of parts: skill greet"
    assert without_unsigned(catalogue, sign()).skills["greet"].implemented
    assert without_unsigned(catalogue, ALL) is catalogue


async def test_a_skill_that_is_edited_at_the_last_moment_is_in_no_container(
    bench: Bench, root: Path, sign: Callable[..., InForce]
) -> None:
    """Between reading the catalogue and the snapshot: its files are in no snapshot, no runner is told of it."""
    counts = sign()
    (root / "greet" / "more.py").write_text("x = 1")
    pool = await bench.pool(parts=counts)
    last, _ = await bench.run(pool, _request("wave"))
    assert last.result == {"said": "hello"}
    trees = bench.folder / "data" / "f1" / "g1" / "snapshots" / "trees"
    assert list(trees.rglob("wave/handler.py"))
    assert not list(trees.rglob("greet"))
    assert pool.refused["unsigned skill"] == 1
    last, _ = await bench.run(pool, _request("greet"))
    assert last.kind is RunEventKind.FAILED


async def test_shared_code_that_was_edited_takes_all_skills_beside_it(
    root: Path, catalogue: Catalogue, sign: Callable[..., InForce]
) -> None:
    """What each skill may load is part of each."""
    counts = sign()
    (root / "_lib").mkdir()
    (root / "_lib" / "evil.py").write_text("import os")
    left = without_unsigned(catalogue, counts).skills
    assert not left["greet"].implemented
    assert not left["wave"].implemented
    assert left["goto"].implemented


async def test_a_running_container_of_an_unsigned_image_is_not_adopted(
    bench: Bench, sign: Callable[..., InForce]
) -> None:
    """A gateway that restarts with another list removes what it does not name."""
    pool = await bench.pool(parts=sign(), floor={"small": 1})
    await bench.ready(pool, 1, "small")
    before = {each.id for each in pool.containers()}
    await pool.stop(keep_containers=True)
    bench.pools.remove(pool)
    counts = sign(small="1" * 64)
    again = await bench.pool(parts=counts, floor={"small": 1})
    await until(lambda: again.refused["unsigned image"] > 0, "the image that is there is refused")
    assert not before & {each.id for each in again.containers()}
    assert not bench.engine.specs
