"""Python packages of an image: what a requirements file may say, which wheel is taken, where its files go."""

import hashlib
import tarfile
import zipfile
from pathlib import Path

import pytest

from appliance.errors import ConfigError, PrerequisiteError
from appliance.pool import wheels
from appliance.pool.wheels import Python
from appliance.skills.catalogue import image_reference, load_catalogue
from appliance.skills.requirements import parse_requirements

FILE = Path("images/x/requirements.txt")
HASH = "sha256:" + "a" * 64
PYTHON = Python(minor=11, site="/usr/local/lib/python3.11/dist-packages")


def write_wheel(
    folder: Path, name: str = "greetings", version: str = "1.0", *, kind: str = "py3-none-any", **files: str
) -> tuple[Path, str]:
    """Write a wheel of one module, and further files by path; returns it and its hash."""
    folder.mkdir(parents=True, exist_ok=True)
    file = folder / f"{name}-{version}-{kind}.whl"
    info = f"{name}-{version}.dist-info"
    contents = {
        f"{name}/__init__.py": f"VERSION = {version!r}\n",
        f"{info}/METADATA": f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\nRequires-Dist: other>=2\n",
        f"{info}/WHEEL": f"Wheel-Version: 1.0\nRoot-Is-Purelib: true\nTag: {kind}\n",
        f"{info}/RECORD": "",
        **files,
    }
    with zipfile.ZipFile(file, "w") as archive:
        for path, text in contents.items():
            archive.writestr(path, text)
    return file, f"sha256:{hashlib.sha256(file.read_bytes()).hexdigest()}"


def test_what_locking_tools_write_is_read() -> None:
    """Continued lines, comments, markers, several hashes and names in any spelling."""
    text = (
        "# by a tool\n\n"
        f"Foo_Bar==1.0.0 ; python_version < '3.12' \\\n    --hash={HASH} \\\n    --hash=sha512:{'b' * 128}\n"
        "    # via something\n"
        f"baz[extra] == 2 --hash={HASH}  # a comment\n"
    )
    first, second = parse_requirements(text, FILE)
    assert (first.name, first.version, first.line, len(first.hashes)) == ("foo-bar", "1.0.0", 3, 2)
    assert first.wanted({"python_version": "3.11"})
    assert not first.wanted({"python_version": "3.13"})
    assert (second.pinned, second.line, second.hashes) == ("baz==2", 7, (HASH,))


@pytest.mark.parametrize(
    ("line", "reason"),
    [
        ("foo==1.0", "foo==1.0: no --hash"),
        (f"foo>=1.0 --hash={HASH}", "not pinned to one version"),
        (f"foo --hash={HASH}", "not pinned to one version"),
        (f"foo==1.* --hash={HASH}", "not pinned to one version"),
        (f"foo==1.0,==1.0 --hash={HASH}", "not pinned to one version"),
        (f"foo @ https://x.example/foo.whl --hash={HASH}", "a URL is not fetched"),
        ("-r other.txt", "options have no place here"),
        ("--index-url https://x.example", "options have no place here"),
        ("foo==1.0 --hash=md5:" + "a" * 32, "not a whole hash"),
        ("foo==1.0 --hash=sha256:" + "a" * 63, "not a whole hash"),
        ("foo==1.0 --hash=sha256:" + "g" * 64, "not a whole hash"),
        (f"./foo.whl --hash={HASH}", "is no requirement"),
        (f"foo==1.0 --hash={HASH} --global-option=x", "is no requirement"),
        (f"good==1 --hash={HASH}", "good is in line 2 too"),
    ],
)
def test_what_is_not_pinned_is_refused_with_its_line(line: str, reason: str) -> None:
    """Whatever would need an index, or let anything in that the file does not name, is an error with file and line."""
    with pytest.raises(ConfigError) as caught:
        parse_requirements(f"\ngood==1 --hash={HASH}\n{line}\n", FILE)
    assert caught.value.message.startswith(f"{FILE}:3: ")
    assert reason in caught.value.message
    assert "--generate-hashes" in caught.value.remedy


def test_a_gateway_is_told_of_a_wrong_requirement_when_it_loads_the_skills(tmp_path: Path) -> None:
    """The catalogue is as strict about this file as about a manifest."""
    folder = tmp_path / "images" / "wheeled"
    folder.mkdir(parents=True)
    (folder / "image.toml").write_text('name = "wheeled"\npackages = ["python3"]\n')
    (folder / "requirements.txt").write_text("foo==1.0\n")
    with pytest.raises(ConfigError, match=r"requirements\.txt:1: foo==1\.0: no --hash"):
        load_catalogue([tmp_path])


def test_the_tag_follows_the_requirements_and_not_the_wheelhouse(tmp_path: Path) -> None:
    """Another pin is another image; a gateway without the wheels knows an image by the same tag."""
    folder = tmp_path / "wheeled"
    folder.mkdir()
    (folder / "image.toml").write_text('name = "wheeled"\npackages = ["python3"]\n')
    tags = [image_reference("wheeled", folder=folder)]
    for pin in ("a", "b"):
        (folder / "requirements.txt").write_text(f"foo==1 --hash=sha256:{pin * 64}\n")
        tags.append(image_reference("wheeled", folder=folder))
        write_wheel(folder / "wheelhouse", version=pin.replace("a", "1").replace("b", "2"))
        assert image_reference("wheeled", folder=folder) == tags[-1]
    assert len(set(tags)) == 3


def _choose(text: str, *folders: Path, python: Python | None = PYTHON) -> str:
    (requirement,) = parse_requirements(text, FILE)
    found = wheels.choose(requirement, wheels.wheels_in(folders), python, file=FILE, folders=folders)
    return str(found.file)


def test_a_wheel_is_taken_by_its_hash(tmp_path: Path) -> None:
    """Of two files of one name the one that is pinned is taken, wherever it is; other files are left out."""
    first, _ = write_wheel(tmp_path / "one", **{"greetings/more.py": "x = 1\n"})
    second, pinned = write_wheel(tmp_path / "two")
    (tmp_path / "one" / "notes.txt").write_text("x")
    (tmp_path / "one" / "bad-name.whl").write_text("x")
    assert first.name == second.name
    assert _choose(f"greetings==1.0 --hash={pinned}", tmp_path / "one", tmp_path / "two") == str(second)
    assert _choose(f"greetings==1 --hash={HASH} --hash={pinned}", tmp_path / "two") == str(second)


def test_what_is_wrong_with_a_wheel_is_said(tmp_path: Path) -> None:
    """Missing, another version, another hash, another Python: file, line, requirement, reason and remedy each time."""
    place = tmp_path / "house"
    file, pinned = write_wheel(place, kind="cp312-cp312-linux_x86_64")
    cases = (
        (f"absent==1.0 --hash={HASH}", f"absent==1.0: no wheel in {place}"),
        (f"greetings==2.0 --hash={HASH}", "which has greetings 1.0"),
        (
            f"greetings==1.0 --hash={HASH}",
            f"wrong hash: {file} has {pinned}",
        ),
        (f"greetings==1.0 --hash={pinned}", "greetings-1.0-cp312-cp312-linux_x86_64.whl is not for Python 3.11"),
    )
    for text, reason in cases:
        with pytest.raises(PrerequisiteError) as caught:
            _choose(text, place)
        assert caught.value.message.startswith(f"{FILE}:1: ")
        assert reason in caught.value.message
        assert caught.value.remedy
    with pytest.raises(ConfigError, match="no readable wheelhouse"):
        wheels.wheels_in([tmp_path / "absent"])


def test_a_missing_wheel_is_found_before_anything_is_built(tmp_path: Path) -> None:
    """Wherever no marker says otherwise; what a marker leaves out needs no wheel."""
    requirements = parse_requirements(f"old==1 ; python_version < '3' --hash={HASH}\nabsent==1 --hash={HASH}\n", FILE)
    with pytest.raises(PrerequisiteError, match="absent==1"):
        wheels.check(requirements, [tmp_path], file=FILE)
    wheels.check(requirements[:1], [tmp_path], file=FILE)


def test_files_of_a_wheel_go_where_they_belong(tmp_path: Path) -> None:
    """Modules beside each other, scripts with the image's Python, data below /usr/local; what it needs is reported."""
    data = {
        "greetings-1.0.data/scripts/greet": "#!python\nprint('hello')\n",
        "greetings-1.0.data/platlib/greetings/fast.py": "x = 1\n",
        "greetings-1.0.data/data/share/greetings.txt": "hello",
        "greetings-1.0.data/headers/greetings.h": "int x;",
    }
    _, pinned = write_wheel(tmp_path / "house", **data)
    root, said = tmp_path / "root", list[str]()
    requirements = parse_requirements(
        f"old==1 ; python_version < '3' --hash={HASH}\ngreetings==1.0 --hash={pinned}", FILE
    )
    wheels.unpack(requirements, [tmp_path / "house"], root, PYTHON, file=FILE, progress=said.append)
    site = root / "usr/local/lib/python3.11/dist-packages"
    assert {each.name for each in (site / "greetings").iterdir()} == {"__init__.py", "fast.py", "__pycache__"}
    assert (site / "greetings-1.0.dist-info" / "METADATA").is_file()
    assert (root / "usr/local/share/greetings.txt").read_text() == "hello"
    script = root / "usr/local/bin/greet"
    assert script.read_text().startswith("#!/usr/bin/env python3\n")
    assert script.stat().st_mode & 0o777 == 0o755
    assert not list(root.rglob("*.h"))
    assert said == [
        "installing greetings-1.0-py3-none-any.whl",
        "greetings needs other>=2, which requirements.txt does not name: a Debian package must bring it",
    ]


@pytest.mark.parametrize("path", ["../../etc/passwd", "/etc/passwd", "greetings-1.0.data/data/../../../x"])
def test_a_wheel_that_leads_outside_is_refused(tmp_path: Path, path: str) -> None:
    """Its hash is right, and yet nothing is written but below the root."""
    _, pinned = write_wheel(tmp_path / "house", **{path: "x"})
    requirements = parse_requirements(f"greetings==1.0 --hash={pinned}", FILE)
    with pytest.raises(PrerequisiteError, match="cannot be unpacked: it holds the path"):
        wheels.unpack(requirements, [tmp_path / "house"], tmp_path / "a" / "root", PYTHON, file=FILE, progress=print)
    assert {each.name for each in tmp_path.iterdir()} <= {"house", "a"}


def test_a_damaged_wheel_is_refused(tmp_path: Path) -> None:
    """A file with the pinned hash that is no archive says so."""
    file, _ = write_wheel(tmp_path / "house")
    file.write_bytes(file.read_bytes()[:100])
    pinned = f"sha256:{hashlib.sha256(file.read_bytes()).hexdigest()}"
    requirements = parse_requirements(f"greetings==1.0 --hash={pinned}", FILE)
    with pytest.raises(PrerequisiteError, match=r"requirements\.txt:1: greetings==1\.0: .* cannot be unpacked"):
        wheels.unpack(requirements, [tmp_path / "house"], tmp_path / "root", PYTHON, file=FILE, progress=print)


def test_a_root_filesystem_is_asked_for_its_python_and_added_to(tmp_path: Path) -> None:
    """The archive's link says which Python it is; what is added belongs to root, and folders stay as they are."""
    archive, root = tmp_path / "root.tar", tmp_path / "root"
    with tarfile.open(archive, "w") as tar:
        for name in ("./usr", "./usr/local"):
            folder = tarfile.TarInfo(name)
            folder.type, folder.mode = tarfile.DIRTYPE, 0o711
            tar.addfile(folder)
        link = tarfile.TarInfo("./usr/bin/python3")
        link.type, link.linkname = tarfile.SYMTYPE, "python3.11"
        tar.addfile(link)
    assert wheels.python_of(archive) == PYTHON
    (root / "usr/local/lib").mkdir(parents=True)
    (root / "usr/local/lib/x.py").write_text("x = 1\n")
    wheels.append(archive, root)
    with tarfile.open(archive) as tar:
        members = {each.name: each for each in tar}
    assert sorted(members) == ["./usr", "./usr/bin/python3", "./usr/local", "./usr/local/lib", "./usr/local/lib/x.py"]
    assert members["./usr"].mode == 0o711
    assert (members["./usr/local/lib/x.py"].uid, members["./usr/local/lib/x.py"].uname) == (0, "root")
    with tarfile.open(tmp_path / "none.tar", "w"):
        pass
    with pytest.raises(PrerequisiteError, match="no python3"):
        wheels.python_of(tmp_path / "none.tar")
