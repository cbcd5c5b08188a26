"""The exported UR5: validation, agreement with numpy, derivatives, saved states, equal bytes, and what may go wrong."""

import importlib.util
import shutil
import struct
import tempfile
import xml.etree.ElementTree as ET
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from fmpy.validation import validate_fmu as validate_by_fmpy

from kit.command import carried_out, python
from kit.foreign_fmu import build_crane, describe_with
from kit.plants import mismatched, setup
from servobench.fmus import compiler as compiling
from servobench.fmus import export
from servobench.fmus.compiler import (
    PLATFORMS,
    CompilationFailed,
    CompilerMissing,
    compile_library,
    parse_platforms,
    this_platform,
)
from servobench.fmus.export import (
    PACKAGES,
    ExportOptions,
    arm_layout,
    export_fmu,
    fingerprint,
    nominal_setup,
)
from servobench.fmus.reference import INPUT_FILE, OUTPUT_FILE, read_table, reference_run
from servobench.fmus.ur5_plant import ENTRY, Ur5FmuConfig, cached_fmu
from servobench.fmus.variables import parameters_of
from servobench.harness.apps.fmu.inspection import read_information, validate_fmu
from servobench.plant.cameras.registry import Sensing
from servobench.plant.cameras.setups import PIXEL, pixels
from servobench.plant.fmu.archive import extract_fmu
from servobench.plant.kinematic import KinematicConfig
from servobench.plant.robot.arm import SerialArm, rotation_from_rpy
from servobench.plant.robot.hand_eye import HandEyeModel
from servobench.plant.robot.mechanics import MechanicsConfig
from servobench.plant.robot.ur5 import JOINT_NAMES

VERSIONS = [2, 3]
SEVERE = replace(nominal_setup(), model=mismatched("severe"))


@pytest.mark.parametrize("version", VERSIONS)
def test_fmpy_finds_no_problem_and_the_reference_run_agrees(version):
    assert validate_by_fmpy(str(cached_fmu(version))) == []
    found = validate_fmu(cached_fmu(version))
    assert found.problems == ()
    assert found.deviation < 1e-12


def test_the_reference_run_agrees_with_play_ripple_and_a_flexible_tool(tmp_path):
    own = KinematicConfig(
        mechanics=MechanicsConfig(backlash=0.02, ripple=0.02, tool_frequency=30.0)
    )
    options = ExportOptions(setup=replace(nominal_setup(), period=0.02), config=own)
    found = validate_fmu(export_fmu(tmp_path / "arm.fmu", options))
    assert found.deviation < 1e-12


@pytest.mark.parametrize("version", VERSIONS)
def test_the_committed_reference_is_still_that_of_the_model(version):
    folder = Path(export.__file__).parent / "ur5_mismatched"
    with zipfile.ZipFile(cached_fmu(version)) as archive:
        for name, tolerance in ((INPUT_FILE, 0.0), (OUTPUT_FILE, 1e-12)):
            header, wanted = read_table((folder / Path(name).name).read_text())
            own_header, came = read_table(archive.read(name).decode())
            assert own_header == header
            np.testing.assert_allclose(came, wanted, rtol=0, atol=tolerance)


def model_of(p, joint_names):
    """Return the arm and camera that the FMU's parameters describe."""
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation_from_rpy(p["camera_rpy"]), p["camera_position"]
    translation = np.vstack([p["base_position"], np.column_stack([p["a"], p["y"], p["d"]])])
    rpy = np.vstack([p["base_rpy"], np.column_stack([p["alpha"], p["pitch"], p["yaw"]])])
    arm = SerialArm(joint_names, translation, rpy, p["joint_offset"], p["gear_ratio"], p["tool"])
    return HandEyeModel(arm, pose)


@pytest.mark.parametrize("mismatch", ["none", "severe", "factory", "gear_ratio=5%"])
def test_a_model_comes_back_from_its_parameters(mismatch):
    model = mismatched(mismatch)
    back = model_of(parameters_of(setup(mismatch), KinematicConfig()), JOINT_NAMES)
    np.testing.assert_allclose(back.X_BC, model.X_BC, rtol=0, atol=1e-12)
    q = np.random.default_rng(0).uniform(-3.0, 3.0, (20, 6))
    np.testing.assert_allclose(back.feature(q), model.feature(q), rtol=0, atol=1e-12)


def test_start_values_are_those_of_the_sampled_mismatch(tmp_path):
    path = export_fmu(tmp_path / "severe.fmu", ExportOptions(2, SEVERE, mismatch="severe, seed 3"))
    starts = {each.name: each.start for each in read_information(path).description.modelVariables}
    wanted = parameters_of(SEVERE, KinematicConfig())
    for group in arm_layout(6).of_role("parameter"):
        assert [float(starts[name]) for name in group.scalar_names()] == wanted[group.name].tolist()
    assert validate_fmu(path).problems == ()
    with zipfile.ZipFile(path) as archive:
        assert "severe, seed 3" in archive.read("documentation/index.html").decode()
    assert [item.name for item in tmp_path.iterdir()] == ["severe.fmu"]


def test_the_fingerprint_changes_with_whatever_an_fmu_is_made_from(monkeypatch, tmp_path):
    plain = fingerprint(ExportOptions(2))
    assert fingerprint(ExportOptions(2)) == plain
    others = [fingerprint(ExportOptions(3)), fingerprint(ExportOptions(2, SEVERE))]
    others.append(fingerprint(ExportOptions(2, platforms=tuple(PLATFORMS.values()))))
    for measure in (pixels, lambda points, optics: 2.0 * pixels(points, optics)):
        own = Sensing(replace(PIXEL, name="own", measure=measure))
        others.append(fingerprint(ExportOptions(2, nominal_setup(sensing=own))))
    monkeypatch.setattr("servobench.fmus.export.CODE", ("-O3",))
    others.append(fingerprint(ExportOptions(2)))
    packages = [Path(shutil.copytree(folder, tmp_path / folder.name)) for folder in PACKAGES]
    monkeypatch.setattr("servobench.fmus.export.PACKAGES", packages)
    assert fingerprint(ExportOptions(2)) == others[-1]
    for package, changed in zip(packages, ("fmi/instance.c", "cameras/symbolic.py"), strict=True):
        with (package / changed).open("a") as file:
            file.write("\n")
        others.append(fingerprint(ExportOptions(2)))
    for compiled in ("an installation without sources", "its next version"):
        (packages[1] / "kinematic.pyc").write_text(compiled)
        others.append(fingerprint(ExportOptions(2)))
    assert len({plain, *others}) == 11


EXPORT = """
import sys
from pathlib import Path
from servobench.fmus.compiler import parse_platforms
from servobench.fmus.export import ExportOptions, export_fmu
export_fmu(Path("again.fmu"), ExportOptions(int(sys.argv[1]), platforms=parse_platforms(sys.argv[2])))
"""
WITH_ZIG = pytest.mark.skipif(
    importlib.util.find_spec("ziglang") is None, reason="ziglang is not installed"
)


@pytest.mark.parametrize("platforms", [this_platform().name, pytest.param("all", marks=WITH_ZIG)])
@pytest.mark.parametrize("version", VERSIONS)
def test_equal_inputs_give_equal_files_in_another_process_folder_and_time(
    version, platforms, tmp_path
):
    first = export_fmu(
        tmp_path / "first.fmu", ExportOptions(version, platforms=parse_platforms(platforms))
    )
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    changed = {"TMPDIR": str(elsewhere), "PYTHONHASHSEED": "7", "TZ": "Asia/Tokyo"}
    python("-c", EXPORT, version, platforms, path=elsewhere, **changed)
    assert first.read_bytes() == (elsewhere / "again.fmu").read_bytes()
    assert [item.name for item in elsewhere.iterdir()] == ["again.fmu"]
    with zipfile.ZipFile(first) as archive:
        content = b"".join(archive.read(name) for name in archive.namelist())
    for path in (tempfile.gettempdir(), str(Path.home()), str(Path.cwd())):
        assert path.encode() not in content


MAGIC = {
    "x86_64-linux": (b"\x7fELF", b"\x3e\x00", 18),
    "aarch64-linux": (b"\x7fELF", b"\xb7\x00", 18),
    "x86_64-darwin": (b"\xcf\xfa\xed\xfe", b"\x07\x00\x00\x01", 4),
    "aarch64-darwin": (b"\xcf\xfa\xed\xfe", b"\x0c\x00\x00\x01", 4),
    "x86_64-windows": (b"MZ", b"", 0),
}


@WITH_ZIG
@pytest.mark.parametrize("version", VERSIONS)
def test_zig_puts_libraries_for_five_platforms_into_one_fmu(version, tmp_path):
    path = export_fmu(
        tmp_path / "all.fmu", ExportOptions(version, platforms=parse_platforms("all"))
    )
    assert set(MAGIC) == set(PLATFORMS)
    with zipfile.ZipFile(path) as archive:
        for name, (magic, machine, offset) in MAGIC.items():
            target = PLATFORMS[name]
            inside = f"binaries/{target.folder(version)}/ur5_mismatched{target.suffix}"
            content = archive.read(inside)
            if version == 2 and name == "x86_64-darwin":  # one file for both processors
                assert content.startswith(b"\xca\xfe\xba\xbe")
                _, _, start, size, _ = struct.unpack_from(">5I", content, 8)
                content = content[start : start + size]
            assert content.startswith(magic), name
            assert content[offset:].startswith(machine), name
            # Whose names share prefixes
            assert f"fmi{version}DoStep".encode() in content or name.endswith("darwin")
    assert validate_fmu(path).problems == ()


@pytest.mark.parametrize("version", VERSIONS)
def test_the_sources_are_clean_c11_and_say_nothing(version, tmp_path):
    with zipfile.ZipFile(cached_fmu(version)) as archive:
        names = [name for name in archive.namelist() if name.startswith("sources/")]
        archive.extractall(tmp_path, names)
    strict = ["-std=c11", "-Wall", "-Wextra", "-Wpedantic", "-Werror", "-O1", "-fPIC", "-c"]
    files = [name.removeprefix("sources/") for name in names if name.endswith(".c")]
    compiler = shutil.which("cc") or "gcc"
    done = carried_out(compiler, *strict, *files, cwd=tmp_path / "sources")
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.skipif(shutil.which("readelf") is None, reason="needs readelf")
@pytest.mark.parametrize("version", VERSIONS)
def test_the_library_needs_libc_and_libm_only(version, tmp_path):
    folder = extract_fmu(cached_fmu(version))
    library = next((folder / "binaries").rglob("*.so"))
    lines = carried_out("readelf", "-d", library).stdout.splitlines()
    needed = [line.partition("[")[2].rstrip("]") for line in lines if "NEEDED" in line]
    assert needed
    assert set(needed) <= {"libc.so.6", "libm.so.6"}


@pytest.mark.parametrize("version", VERSIONS)
def test_information_tells_version_platform_and_variables(version):
    information = read_information(cached_fmu(version))
    described = information.description
    assert described.fmiVersion == f"{version}.0"
    assert information.platforms == (this_platform().folder(version),)
    assert information.has_sources
    assert list(information.interfaces) == ["co-simulation", "model exchange"]
    for capabilities in information.interfaces.values():
        assert {"cangetandsetfmustate", "canserializefmustate"} < {
            name.lower() for name in capabilities
        }
        assert any(name.startswith("providesDirectionalDerivative") for name in capabilities)
    assert len(described.modelVariables) == (203 if version == 2 else 39)
    assert (
        all(variable.unit and variable.description for variable in described.modelVariables)
        or version == 2
    )


@pytest.mark.parametrize("version", VERSIONS)
def test_the_license_is_in_the_description_and_shown(version, output_of):
    with zipfile.ZipFile(cached_fmu(version)) as archive:
        root = ET.fromstring(archive.read("modelDescription.xml"))
    assert root.attrib["license"] == "BSD-3-Clause"
    assert "\nlicense: BSD-3-Clause\n" in output_of("fmu", "info", cached_fmu(version))


@pytest.mark.parametrize("version", VERSIONS)
def test_the_license_of_a_foreign_fmu_is_shown_if_it_has_one(version, output_of, tmp_path):
    name = 'modelName="Crane"'
    licensed = describe_with(version, name, f'{name} license="[MIT] of its maker"')
    one = build_crane(tmp_path / "licensed.fmu", version, description=licensed)
    none = build_crane(tmp_path / "crane.fmu", version)
    assert "\nlicense: [MIT] of its maker\n" in output_of("fmu", "info", one)
    assert "license" not in output_of("fmu", "info", none)


def problems_of(target: Path, name: str, old: bytes, new: bytes) -> tuple[str, ...]:
    """Return what is wrong with an FMU of which one file has other words at one place."""
    with zipfile.ZipFile(cached_fmu(2)) as archive:
        contents = {entry: archive.read(entry) for entry in archive.namelist()}
    contents[name] = contents[name].replace(old, new, 1)
    with zipfile.ZipFile(target, "w") as archive:
        for entry, content in contents.items():
            archive.writestr(entry, content)
    found = validate_fmu(target)
    return (*found.problems, *found.departures)


def test_validation_tells_what_is_wrong(tmp_path):
    changed = problems_of(tmp_path / "a.fmu", OUTPUT_FILE, b"\n0.05,", b"\n0.05,9")
    assert "differs from the reference" in changed[0]
    unit = problems_of(tmp_path / "b.fmu", "modelDescription.xml", b'"m/rad"', b'"x"')
    assert any("unit" in problem for problem in unit)
    token = problems_of(tmp_path / "c.fmu", "modelDescription.xml", b'guid="{', b'guid="{0')
    assert "the GUID is not that of this model" in token[0]


def test_bad_exports_are_refused(tmp_path, monkeypatch):
    with pytest.raises(ValueError, match="fmi_version must be 2 or 3, got 1"):
        ExportOptions(1)
    with pytest.raises(ValueError, match="platforms must name at least one"):
        ExportOptions(2, platforms=())
    with pytest.raises(
        ValueError, match=r"platforms holds 'amiga'; known are x86_64-linux.*and 'all'"
    ):
        parse_platforms("amiga")
    with pytest.raises(ValueError, match="fmi_version must be one of 2, 3, got 4"):
        Ur5FmuConfig(fmi_version=4)
    monkeypatch.delenv("CC", raising=False)
    monkeypatch.setattr(compiling.shutil, "which", lambda _: None)
    monkeypatch.setattr(compiling.importlib.util, "find_spec", lambda _: None)
    with pytest.raises(
        CompilerMissing, match=r"install gcc or clang.*zig with pip install 'servobench\[cross\]'"
    ):
        export_fmu(tmp_path / "ur5.fmu", ExportOptions(2))
    assert list(tmp_path.iterdir()) == []
    cached_fmu.cache_clear()
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    with pytest.raises(ValueError, match="install gcc or clang"):
        ENTRY.build(Ur5FmuConfig(), setup())
    (tmp_path / "file").write_text("no folder")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    with pytest.raises(
        ValueError, match="FMU cannot be built: cache folder .* cannot be written: .*XDG_CACHE_HOME"
    ):
        ENTRY.build(Ur5FmuConfig(), setup())
    cached_fmu.cache_clear()


def test_a_compiler_that_refuses_the_sources_is_quoted(tmp_path):
    (tmp_path / "bad.c").write_text("int main(void) { return nothing; }\n")
    with pytest.raises(CompilationFailed, match=r"failed for .*nothing"):
        compile_library(tmp_path, ["bad.c"], this_platform(), tmp_path / "out" / "bad.so")


def test_the_reference_run_meets_the_speed_limit():
    run_ = reference_run(nominal_setup(), KinematicConfig())
    assert (np.abs(run_["joint_velocity_command"]) > 1.0).any()
    assert np.abs(run_["joint_velocity"]).max() <= 1.0
