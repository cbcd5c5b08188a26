"""The C compiler that is taken, where CC may hold options, and the folders of libraries in an FMU."""

import shutil
import struct

import pytest

from servobench.fmus.compiler import (
    PLATFORMS,
    CompilerMissing,
    compile_library,
    library_files,
    this_platform,
)

SOURCE = "#ifndef ANSWER\n#error no answer\n#endif\nint answer(void) { return ANSWER; }\n"


@pytest.mark.skipif(shutil.which("cc") is None, reason="needs a C compiler")
def test_cc_may_hold_options(tmp_path, monkeypatch):
    monkeypatch.setenv("CC", "cc -DANSWER='6 * 7'")
    (tmp_path / "answer.c").write_text(SOURCE)
    compile_library(tmp_path, ["answer.c"], this_platform(), tmp_path / "answer.so")
    assert (tmp_path / "answer.so").stat().st_size > 0


@pytest.mark.parametrize("command", ["no_such_compiler -m64", "'unfinished"])
def test_a_cc_that_is_not_there_is_named(command, tmp_path, monkeypatch):
    monkeypatch.setenv("CC", command)
    with pytest.raises(CompilerMissing, match="CC names .*which was not found"):
        compile_library(tmp_path, ["answer.c"], this_platform(), tmp_path / "answer.so")


MAC = {
    name: b"\xcf\xfa\xed\xfe" + struct.pack("<II", cpu, 3) + name.encode()
    for name, cpu in (("x86_64-darwin", 0x01000007), ("aarch64-darwin", 0x0100000C))
}


def files(*names: str, version: int = 2):
    return library_files(
        {PLATFORMS[name]: MAC.get(name, name.encode()) for name in names}, "arm", version
    )


def test_macos_finds_a_library_for_both_processors_where_fmi_2_has_one_folder():
    found = files(*MAC)
    assert sorted(found) == ["binaries/aarch64-darwin/arm.dylib", "binaries/darwin64/arm.dylib"]
    assert found["binaries/aarch64-darwin/arm.dylib"] == MAC["aarch64-darwin"]
    both = found["binaries/darwin64/arm.dylib"]
    magic, count = struct.unpack_from(">II", both)
    assert (magic, count) == (0xCAFEBABE, 2)
    for k, content in enumerate(MAC.values()):
        processor, _, offset, size, alignment = struct.unpack_from(">5I", both, 8 + 20 * k)
        assert processor == struct.unpack_from("<I", content, 4)[0]
        assert both[offset : offset + size] == content
        assert offset % 2**alignment == 0
    assert set(files("aarch64-darwin").values()) == {MAC["aarch64-darwin"]}
    assert sorted(files(*MAC, version=3)) == [f"binaries/{name}/arm.dylib" for name in sorted(MAC)]


def test_an_fmu_for_arm_linux_alone_is_found_where_importers_of_fmi_2_look():
    alone = {
        "binaries/aarch64-linux/arm.so": b"aarch64-linux",
        "binaries/linux64/arm.so": b"aarch64-linux",
    }
    assert files("aarch64-linux") == alone
    assert files("aarch64-linux", "x86_64-linux")["binaries/linux64/arm.so"] == b"x86_64-linux"
    assert list(files("aarch64-linux", version=3)) == ["binaries/aarch64-linux/arm.so"]
