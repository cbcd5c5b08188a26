"""The files that a batch reads because a user named them: found, and looked at again when a folder is resumed."""

import hashlib
from pathlib import Path

import pytest

import servobench
from kit.own import CELL, WHOLE
from servobench.harness.batch.manifest import named_files
from servobench.harness.batch.plan import Survey
from servobench.harness.config.source import neighbours
from servobench.plant.contract.faults import ConfigurationError
from servobench.plant.robot import ur5

MINE = "import helper\nfrom laws import gain\n" + WHOLE.replace(
    "np.zeros(self.n)", "np.full(self.n, gain.VALUE * helper.SPEED)"
)
CODE = {"mine.py": MINE, "helper.py": "SPEED = 0.01\n", "laws/__init__.py": "", "laws/gain.py": "VALUE = 1.0\n"}
WAYPOINTS = "time_s,x_m,y_m,z_m\n0,0.4,0.1,1.2\n1,0.4,0.0,1.2\n"
pytestmark = pytest.mark.usefixtures("own_folder")
SHORT = {"exp1": {"duration": 0.2}}


def write(files):
    for name, text in files.items():
        Path(name).parent.mkdir(exist_ok=True)
        Path(name).write_text(text)


def copied(name, source):
    Path(name).write_bytes(Path(source).read_bytes())


def robot():
    copied("arm.yaml", ur5.shipped_calibration())
    return {"robot": "./arm.yaml", "tasks": ["random"], "settings": {"random": {"duration": 0.2}}}


def mismatch():
    copied("factory.yaml", ur5.shipped_calibration())
    return {"mismatches": ["factory=./factory.yaml"]}


def task():
    write({"path.csv": WAYPOINTS})
    return {"tasks": ["waypoints"], "settings": {"waypoints": {"file": "path.csv", "settle": 0.1}}}


def plant():
    write({"cell.py": CELL})
    return {"plants": ["./cell.py"]}


def sensing():
    write(
        {
            "side.py": "from servobench.plant.cameras.setups import SensingSetup\n"
            "SIDE = SensingSetup('side', '', ('x', 'y', 'z'), 'm', lambda points, optics: points[..., 0, 0, :])\n"
        }
    )
    return {"plants": ["kinematic"], "sensings": ["./side.py"]}


def camera():
    write({"eye.toml": "width = 640\nheight = 480\nvertical_fov = 60.0\n"})
    return {"robot": "ur5 with eye.toml", "sensings": ["pixel"]}


CASES = {  # what is asked for, and which file changes
    "robot": (robot, "arm.yaml"),
    "mismatch": (mismatch, "factory.yaml"),
    "task": (task, "path.csv"),
    "plant": (plant, "cell.py"),
    "sensing": (sensing, "side.py"),
    "camera": (camera, "eye.toml"),
}


@pytest.mark.parametrize("case", CASES)
def test_a_folder_is_not_resumed_with_another_version_of_a_file(case):
    ask, name = CASES[case]
    refused(["constant"], name, **({"settings": SHORT} | ask()))


def test_nor_with_another_version_of_a_module_beside_a_file():
    write(CODE)
    refused(["./mine.py"], "helper.py", settings=SHORT)
    write(CODE)
    refused(["./mine.py"], "laws/gain.py", resume=True, settings=SHORT)


def refused(controllers, name, *, resume=False, **asked):
    """Begin a folder, or go on with it, and resume it; then change the file `name`."""
    asked |= {"out": "folder"}
    begun = servobench.compare(controllers, resume=resume, **asked)
    resumed = servobench.compare(controllers, resume=True, **asked)
    assert resumed["run_id"].tolist() == begun["run_id"].tolist()
    with Path(name).open("a") as file:
        file.write("\n")
    line = f"^folder was begun with another version of (\\./)?{name}; name another folder with --out, or bring"
    with pytest.raises(ConfigurationError, match=line):
        servobench.compare(controllers, resume=True, **asked)


def test_an_fmu_is_looked_at_also_where_a_mapping_names_it():
    write({"cell/crane.toml": 'file = "../lib/crane.fmu"\n', "lib/crane.fmu": "1", "pilot.fmu": "2"})
    names = {"fmu:cell/crane.toml": None}, {"fmu:pilot.fmu": None, "constant": None}
    found = named_files(Survey(plants=names[0], controllers=names[1]), {}, ())
    assert list(found) == ["cell/crane.toml", "cell/../lib/crane.fmu", "pilot.fmu"]
    assert found["pilot.fmu"] == hashlib.sha256(b"2").hexdigest()


def test_neighbours_are_found_through_packages_and_relative_imports(tmp_path):
    write({
        "mine.py": "import numpy\nimport a.b\nfrom c import thing\n", "a/__init__.py": "", "a/b.py": "from . import d",
        "a/d.py": "import mine\n", "a/unused.py": "", "c.py": "if False:\n    import e\n", "e.py": "def broken(:\n",
        "f.py": "",
    })  # fmt: skip
    names = [str(path.relative_to(tmp_path)) for path in neighbours(tmp_path / "mine.py", tmp_path)]
    assert names == ["a/__init__.py", "a/b.py", "a/d.py", "c.py", "e.py"]
