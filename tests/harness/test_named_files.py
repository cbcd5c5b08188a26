"""The files that a batch reads because a user named them: found, and looked at again when a folder is resumed."""

import hashlib
from pathlib import Path

import pytest

import servobench
from kit.own import CELL, WHOLE
from servobench.harness.apps.tuning.objective import TuningSet, open_ledger
from servobench.harness.batch.manifest import named_files
from servobench.harness.batch.plan import Survey
from servobench.harness.config.registry import choose_plant, offering
from servobench.harness.config.source import neighbours
from servobench.plant.contract.faults import ConfigurationError
from servobench.plant.robot import ur5

BESIDE = "import helper\n" + WHOLE.replace("np.zeros(self.n)", "np.full(self.n, helper.SPEED)")
BELOW = "from laws import gain\n" + WHOLE.replace("np.zeros(self.n)", "np.full(self.n, gain.SPEED)")
CALIBRATION = ur5.CALIBRATION.read_text()
WAYPOINTS = "time_s,x_m,y_m,z_m\n0,0.4,0.1,1.2\n1,0.4,0.0,1.2\n"
SETUP = """from servobench.plant.cameras.setups import SensingSetup
SIDE = SensingSetup('side', '', ('x', 'y', 'z'), 'm', lambda points, optics: points[..., 0, 0, :])
"""
EYE = "width = 640\nheight = 480\nvertical_fov = 60.0\n"
PATH = {"waypoints": {"file": "path.csv", "settle": 0.1}}
SHORT = {"exp1": {"duration": 0.2}, "random": {"duration": 0.2}}
CASES = {  # the files, the first of which changes, and what is asked for
    "robot": ({"arm.yaml": CALIBRATION}, {"robot": "./arm.yaml", "tasks": ["random"]}),
    "mismatch": ({"factory.yaml": CALIBRATION}, {"mismatches": ["factory=./factory.yaml"]}),
    "task": ({"path.csv": WAYPOINTS}, {"tasks": ["waypoints"], "settings": PATH}),
    "plant": ({"cell.py": CELL}, {"plants": ["./cell.py"]}),
    "sensing": ({"side.py": SETUP}, {"plants": ["kinematic"], "sensings": ["./side.py"]}),
    "camera": ({"eye.toml": EYE}, {"robot": "ur5 with eye.toml", "sensings": ["pixel"]}),
    "module": ({"helper.py": "SPEED = 0.01\n", "mine.py": BESIDE}, {"controllers": ["./mine.py"]}),
    "module of a package": (
        {"laws/gain.py": "SPEED = 0.01\n", "laws/__init__.py": "", "mine.py": BELOW},
        {"controllers": ["./mine.py"]},
    ),
}
pytestmark = pytest.mark.usefixtures("own_folder")


def write(files):
    for name, text in files.items():
        Path(name).parent.mkdir(exist_ok=True)
        Path(name).write_text(text)


@pytest.mark.parametrize("case", CASES)
def test_a_folder_is_not_resumed_with_another_version_of_a_file(case):
    files, asked = CASES[case]
    write(files)
    asked = {"controllers": ["constant"], "settings": SHORT, "out": "folder"} | asked
    begun = servobench.compare(**asked)
    resumed = servobench.compare(resume=True, **asked)
    assert resumed["run_id"].tolist() == begun["run_id"].tolist()
    name = next(iter(files))
    with Path(name).open("a") as file:
        file.write("\n")
    line = f"^folder was begun with another version of (\\./)?{name}; give another folder as `out`, or bring"
    with pytest.raises(ConfigurationError, match=line):
        servobench.compare(resume=True, **asked)


def test_a_study_is_not_continued_with_another_version_of_a_module_of_its_plant():
    write({"cell.py": f"import gear\n{CELL}", "gear.py": ""})
    with offering():
        runs = TuningSet((choose_plant("./cell.py"),))
        open_ledger(Path(), "rls", runs).add({}, [1.0])
        assert open_ledger(Path(), "rls", runs).costs({}) == [1.0]
        write({"gear.py": "RATIO = 0.5"})
        with pytest.raises(
            ConfigurationError, match=r"^study rls.jsonl was made with other plants"
        ):
            open_ledger(Path(), "rls", runs)


def test_an_fmu_is_looked_at_also_where_a_mapping_names_it():
    write(
        {"cell/crane.toml": 'file = "../lib/crane.fmu"\n', "lib/crane.fmu": "1", "pilot.fmu": "2"}
    )
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
