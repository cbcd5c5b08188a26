"""Files whose names hold marks with a meaning elsewhere, or capitals: taken as they stand where they exist."""

from pathlib import Path

import pytest

from kit.controller_fmus import exported
from kit.own import WHOLE
from kit.robots import FOUR_JOINTS
from servobench.harness.apps.studies.challenge import FOLDER, find_challenge
from servobench.harness.batch import results
from servobench.harness.batch.logs import logged_in_file
from servobench.harness.batch.results import ResultsFolder
from servobench.harness.config.registry import choose_controller, choose_plant, is_foreign_plant
from servobench.harness.config.sensing import find_sensing
from servobench.harness.config.settings import read_settings
from servobench.plant.contract.faults import ConfigurationError
from servobench.plant.contract.files import split_words
from servobench.plant.robot.catalogue import (
    RobotWord,
    find_robot,
    read_word,
    short_name,
    with_camera,
)
from servobench.plant.robot.mismatch import Mismatch

EYE = "width = 640\nheight = 480\nvertical_fov = 60.0\n"
pytestmark = pytest.mark.usefixtures("own_folder")


def write(name, text=""):
    path = Path(name)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)
    return path


@pytest.mark.parametrize(
    "name",
    [
        "arm with gripper.toml",
        "arm#2.toml",
        "work with arm/dh.toml",
        "a,b=c+d.toml",
        "ARM.TOML",
        "ur5 with gripper.toml",
    ],
)
def test_a_robot_is_found_under_any_name_of_its_file(name):
    write(name, FOUR_JOINTS)
    assert find_robot(name).n == find_robot(str(Path(name).absolute())).n == 4
    assert short_name(str(Path(name).absolute())) == Path(name).name
    camera = write("my eye with a #2 lens.TOML", EYE)
    word = with_camera(name, camera)
    assert (find_robot(word).n, find_robot(word).camera.keys.width) == (4, 640)


def test_a_camera_is_that_of_the_option_beside_a_file_called_as_robot_and_camera():
    write("ur5 with eye.toml", FOUR_JOINTS)
    robot = find_robot(with_camera("ur5", write("eye.toml", EYE)))
    assert (robot.n, robot.camera.keys.width) == (6, 640)


@pytest.mark.parametrize(
    ("text", "parts"),
    [
        ("ur5 with a with b.toml", RobotWord("ur5", "", "a with b.toml")),
        ("no.urdf#tool0 with eye.yaml", RobotWord("no.urdf", "tool0", "eye.yaml")),
        ("random_arm:7 with eye#1.yaml", RobotWord("random_arm:7", "", "eye#1.yaml")),
        ("/work with arm/no.urdf", RobotWord("/work with arm/no.urdf")),
        ("work with arm/no.urdf", RobotWord("work with arm/no.urdf")),
        ("no#2.urdf", RobotWord("no#2.urdf")),
    ],
)
def test_a_robot_without_a_file_is_read_by_its_marks(text, parts):
    assert read_word(text) == parts


def test_a_list_has_files_with_commas_in_their_paths():
    for name in ("a,b/law.py", "c,d,e.FMU", "f,1.yaml", "g,h/side.py"):
        write(name)
    words = [
        "a,b/law.py:Law",
        "x=a,b/law.py",
        "fmu:c,d,e.FMU",
        "factory=f,1.yaml",
        "g,h/side.py:hand",
        "mfac+rls",
    ]
    assert split_words(" , ".join(words)) == tuple(words)
    assert split_words("no,b/law.py,,x ,") == ("no", "b/law.py", "x")
    assert split_words("c,a,b", known=("a,b",)) == ("c", "a,b")
    assert len(split_words("a.py," * 5000)) == 5000


@pytest.mark.parametrize("place", ["LAW.PY", "a=b.py", "v=a=b.py", "v=LAW.PY", "a,b+c#d.py"])
def test_a_controller_is_found_under_any_name_of_its_file(place):
    write(place.removeprefix("v="), WHOLE)
    assert choose_controller(place) == ("v" if place.startswith("v=") else "Mine")


def test_other_files_are_found_under_any_name():
    write("eye+1.PY", "from servobench.plant.cameras.setups import SensingSetup\nSIDE = SensingSetup('side', '', ('x', "
          "'y', 'z'), 'm', lambda points, optics: points[..., 0, 0, :])\n")  # fmt: skip
    assert find_sensing("eye+1.PY:hand").setup.name == "side"
    write("x,1.TOML", (FOLDER / "severe.toml").read_text())
    assert find_challenge("x,1.TOML").title == find_challenge("severe").title
    calibration = write("a+b=c.yaml")
    mismatch = Mismatch.parse(f"factory={calibration}+gear_ratio=5%")
    assert (mismatch.calibration, str(mismatch)) == (
        "a+b=c.yaml",
        "factory=a+b=c.yaml+gear_ratio=5%",
    )
    write("1#2.csv")
    settings = read_settings(
        None, ["waypoints.file=1#2.csv", "exp1.duration=4 # s", "fmu:a=b.TOML.lag=0.1"]
    )
    assert settings.sections["waypoints"]["file"] == "1#2.csv"
    assert settings.sections["exp1"]["duration"] == 4
    assert settings.sections["fmu:a=b.TOML"]["lag"] == 0.1


def test_an_fmu_has_the_name_that_a_user_gives_it(output_of):
    pilot = exported("rbf_pid:published", 2)
    write("pilot,1.FMU").write_bytes(pilot.read_bytes())
    short = (
        "--set",
        "exp1.duration=0.2",
        "--no-figures",
        "--no-report",
        "--workers",
        "1",
        "--out",
        "runs",
    )
    output_of(
        "compare",
        "--controllers",
        "mine=pilot,1.FMU,rbf_pid:published",
        "--tasks",
        "exp1",
        "--seeds",
        "2",
        *short,
    )
    runs = results.load_runs(Path("runs"))
    assert runs["controller"].tolist() == ["mine", "mine", "rbf_pid:published", "rbf_pid:published"]
    own, original = (
        runs[runs["controller"] == name]["rms_error"].tolist()
        for name in ("mine", "rbf_pid:published")
    )
    assert own == pytest.approx(original, rel=1e-9)
    manifest = ResultsFolder(Path("runs")).manifest
    assert manifest["own_controllers"]["mine"]["place"] == "fmu:pilot,1.FMU"
    assert "pilot,1.FMU" in manifest["files"]


def test_a_mapped_plant_has_the_name_that_a_user_gives_it():
    write("cell.FMU")
    write("cell.TOML", 'file = "cell.FMU"\ninputs = ["u"]\njoints = ["q"]\nfeatures = ["y"]\n')
    assert choose_plant("lab=./cell.TOML") == "lab"
    assert not is_foreign_plant("lab", trusted=True)
    assert is_foreign_plant("lab")
    with pytest.raises(ConfigurationError, match=r"fmu file no\.fmu does not exist"):
        choose_plant("lab=no.fmu")
    with pytest.raises(ConfigurationError, match="a plant called 'kinematic' exists already"):
        choose_plant("kinematic=cell.TOML")


def test_a_log_in_capitals_is_a_table():
    write("LOG.CSV", "time_s\n0.0\n0.05\n")
    assert logged_in_file(Path("LOG.CSV"), "constant", "ur10e", "position")[1][
        "time_s"
    ].tolist() == [0.0, 0.05]
