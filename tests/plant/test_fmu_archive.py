"""What a foreign archive may hold: bombs, damage, links and names that lead elsewhere are refused in one line."""

import re
import stat
import struct
import zipfile
from pathlib import Path

import pytest

from servobench.plant.contract import checksums
from servobench.plant.contract.cache import cache_folder
from servobench.plant.fmu import archive
from servobench.plant.fmu.archive import extract_fmu
from servobench.plant.fmu.description import read_description

INTERFACE = '<CoSimulation modelIdentifier="crane"/>'
VARIABLE = '<ScalarVariable name="v" valueReference="1" causality="input"><Real start="0"/></ScalarVariable>'


@pytest.fixture(autouse=True)
def fresh(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))


def describe(
    interface: str = INTERFACE,
    variables: str = VARIABLE,
    version: str = "2.0",
    encoding: str = "UTF-8",
) -> str:
    return (
        f'<?xml version="1.0" encoding="{encoding}"?><fmiModelDescription fmiVersion="{version}" modelName="Crane" '
        f'guid="x" instantiationToken="x">{interface}<ModelVariables>{variables}</ModelVariables><ModelStructure/>'
        "</fmiModelDescription>"
    )


def pack(path: Path, more: dict[str, bytes], description: str | None = None) -> Path:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as packed:
        packed.writestr("modelDescription.xml", description or describe())
        for name, content in more.items():
            packed.writestr(name, content)
    return path


def refused(path: Path) -> str:
    with pytest.raises(ValueError, match="fmu file") as caught:
        read_description(path, extract_fmu(path))
    message = str(caught.value)
    assert message.startswith(f"fmu file {path}")
    assert "\n" not in message
    left = cache_folder("extracted")
    assert not left.exists() or all(
        each.is_file() or (each / "SHA256SUMS").is_file() for each in left.iterdir()
    )
    return message


def test_a_bomb_is_refused_by_its_ratio_before_it_is_unpacked(tmp_path):
    path = pack(tmp_path / "bomb.fmu", {"resources/zeros": bytes(20_000_000)})
    message = refused(path)
    assert re.search(
        r"unpacks to 20 MB, \d{3,4} times its own size; at most 100 times is allowed", message
    )
    assert "pack it again without compression (zip -0 -r)" in message
    with (
        zipfile.ZipFile(path) as packed,
        zipfile.ZipFile(tmp_path / "trusted.fmu", "w") as unpacked,
    ):
        for name in packed.namelist():
            unpacked.writestr(name, packed.read(name))
    assert (
        extract_fmu(tmp_path / "trusted.fmu") / "resources" / "zeros"
    ).stat().st_size == 20_000_000


@pytest.mark.parametrize(
    ("limit", "value", "message"),
    [
        (
            "MAX_UNPACKED",
            1000,
            "unpacks to 0 MB; at most 0 MB are unpacked: keep large files of its resources outside",
        ),
        ("MAX_FILES", 1, "holds 2 files; at most 1 are unpacked"),
        (
            "MAX_DESCRIPTION",
            100,
            "has a modelDescription.xml of 0 MB; at most 0 MB are read: export the FMU with fewer",
        ),
    ],
)
def test_each_limit_is_told_with_its_figure_and_remedy(
    limit, value, message, tmp_path, monkeypatch
):
    monkeypatch.setattr(archive, limit, value)
    assert message in refused(
        pack(tmp_path / "large.fmu", {"resources/large": bytes(range(256)) * 8})
    )


def test_an_archive_never_unpacks_to_more_than_its_table_of_contents_says(tmp_path):
    path = pack(tmp_path / "liar.fmu", {"resources/zeros": bytes(20_000_000)})
    content = path.read_bytes()
    assert content.count(struct.pack("<I", 20_000_000)) == 2
    path.write_bytes(content.replace(struct.pack("<I", 20_000_000), struct.pack("<I", 1000)))
    assert "cannot be extracted: 'resources/zeros': Bad CRC-32" in refused(path)


@pytest.mark.parametrize(
    "identifier",
    [
        "../../evil",
        "/tmp/evil",
        "a/b",
        "a\\b",
        "..",
        ".",
        "",
        "c:evil",
        ".hidden",
        "a" * 300,
        "a&#10;b",
    ],
)
def test_an_identifier_that_is_no_plain_name_is_refused(identifier, tmp_path):
    interface = f'<CoSimulation modelIdentifier="{identifier}"/>'
    message = refused(pack(tmp_path / "crane.fmu", {}, describe(interface)))
    assert (
        "which is no name of a library: wanted letters, digits and '_', without folders" in message
    )
    assert len(message) < 600


def test_a_link_in_an_archive_is_not_followed(tmp_path):
    (tmp_path / "evil.so").write_text("evil")
    link = zipfile.ZipInfo("resources/link")
    link.create_system, link.external_attr = 3, (stat.S_IFLNK | 0o777) << 16
    path = pack(tmp_path / "crane.fmu", {})
    with zipfile.ZipFile(path, "a") as packed:
        packed.writestr(link, str(tmp_path / "evil.so"))
    assert not (extract_fmu(path) / "resources" / "link").is_symlink()
    assert (extract_fmu(path) / "resources" / "link").read_text() == str(tmp_path / "evil.so")


@pytest.mark.parametrize(
    ("description", "message"),
    [
        (describe(encoding="klingon"), "has a broken modelDescription.xml: unknown encoding"),
        (
            describe(encoding="utf-7"),
            "has a broken modelDescription.xml: multi-byte encodings are not supported",
        ),
        (
            describe(variables=VARIABLE.replace('"1"', f'"{2**32}"')),
            "has a variable 'v' with the value reference 4294967296; wanted a name and 32 bits",
        ),
        (
            describe(
                variables='<Float64 name="v" valueReference="1" start="0"><Dimension start="1000000000000"/></Float64>',
                version="3.0",
            ),
            "the size of 'v' must be a whole number up to 1,000,000, got 1000000000000",
        ),
        (describe(version="9" * 4000), "is of FMI ...; wanted FMI 2 or 3"),
    ],
)
def test_a_description_that_makes_no_sense_is_one_line(description, message, tmp_path):
    assert message in refused(pack(tmp_path / "crane.fmu", {}, description))


def test_cuts_and_flips_of_an_archive_are_read_or_refused_in_one_line(tmp_path):
    content = pack(
        tmp_path / "good.fmu", {"binaries/linux64/crane.so": bytes(range(256))}
    ).read_bytes()
    path, refusals = tmp_path / "bad.fmu", []
    for place in range(0, len(content), 37):
        for bad in (
            content[:place],
            content[:place] + bytes([content[place] ^ 0x15]) + content[place + 1 :],
        ):
            path.write_bytes(bad)
            checksums._digest.cache_clear()
            try:
                extract_fmu(path)
            except ValueError as error:
                refusals.append(str(error))
    assert len(refusals) > 20
    assert [
        each for each in refusals if "\n" in each or not each.startswith(f"fmu file {path} ")
    ] == []


@pytest.mark.parametrize(
    "name", ["..\\x", "a\\..\\..\\x", "C:\\x", "\\x", "\\\\server\\x", "a\\../../x", "../x", "/x"]
)
def test_a_name_that_climbs_with_any_separator_is_refused(tmp_path, name):
    assert f"holds {name!r}, which would climb out" in refused(
        pack(tmp_path / "a.fmu", {name: b"x"})
    )


def test_backslashes_of_an_archive_are_separators_also_of_folders_alone(tmp_path):
    path = pack(
        tmp_path / "a.fmu",
        {"resources\\": b"", "resources\\deep\\": b"", "resources\\deep/x": b"1"},
    )
    assert (extract_fmu(path) / "resources" / "deep" / "x").read_bytes() == b"1"
    again = pack(tmp_path / "b.fmu", {"resources\\x": b"1", "resources/x": b"2"})
    assert "holds a file twice, with '/' and with" in refused(again)


def test_names_in_utf_8_without_a_mark_keep_their_letters(tmp_path):
    path = pack(tmp_path / "a.fmu", {"resources/größe.txt": b"1", "resources/gain.txt": b"2"})
    content = path.read_bytes()
    marked = [i for i in range(len(content)) if content[i : i + 4] in (b"PK\3\4", b"PK\1\2")]
    for i in marked:
        flags = i + (6 if content[i : i + 4] == b"PK\3\4" else 8)
        content = content[: flags + 1] + bytes([content[flags + 1] & ~0x08]) + content[flags + 2 :]
    path.write_bytes(content)
    assert sorted(each.name for each in (extract_fmu(path) / "resources").iterdir()) == [
        "gain.txt",
        "größe.txt",
    ]
