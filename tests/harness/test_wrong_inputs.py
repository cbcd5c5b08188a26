"""Two hundred wrong inputs over all commands: each is one right line and exit code 2, and nothing is written."""

from pathlib import Path

import numpy as np
import pytest

from kit.command import servobench
from kit.folders import comparison
from kit.robots import FOUR_JOINTS
from servobench.harness.config.settings import Settings
from servobench.harness.run.references import FixedPoint
from servobench.harness.run.rehearsal import build_once
from servobench.harness.run.request import RunRequest
from servobench.harness.run.resolution import resolve
from servobench.harness.run.scenario import Scenario
from servobench.plant.contract.settings import remark

RUN = ("run", "--plant", "kinematic", "--controller", "constant")
COMPARE = ("compare", "--controllers", "constant", "--tasks", "exp2")
SWEEP = ("sweep", "--controllers", "constant", "--out", "new")
CAMERA = "width = 640\nheight = 480\nvertical_fov = 60.0\n"
INFO = "width: 640\nheight: 480\nk: [615, 0, 320, 0, 615, 240, 0, 0, 1]\n"
FILES: dict[str, str | bytes] = {  # name -> content
    "unknown_section.toml": "[kinematc]\nlag = 0.1\n",
    "bad_value.toml": "[ukf_mpc.law]\nhorizon_time = -1\n",
    "no_section.toml": "lag = 0.1\n",
    "text.csv": "time_s,x_m,y_m,z_m\n0,0,0,far\n",
    "backwards.csv": "time_s,x_m,y_m,z_m\n1,0,0,1.2\n0,0,0,1.2\n",
    "columns.csv": "t,x,y,z\n0,0,0,1.2\n",
    "clock.csv": "time_s,x_m,y_m,z_m\n1760000000,0,0,1.25\n1760000002,0,0,1.25\n",
    "semicolons.csv": "time_s;x_m;y_m;z_m\n0;0,5;0;1,25\n",
    "decimal_commas.csv": "time_s,x_m,y_m,z_m\n0,0,0,5,0,0,1,25\n",
    "empty.csv": "",
    "utf_16.toml": "[kinematic]\nlag = 0.1\n".encode("utf-16"),
    "far.csv": "time_s,x_m,y_m,z_m\n0,0,0,1.25\n5,0,9,1.25\n",
    "before.csv": "time_s,x_m,y_m,z_m\n-1,0,0,1.2\n1,0,0,1.2\n",
    "slow.csv": "time_s,x_m,y_m,z_m\n0,0,0,1.25\n6000,0,0.1,1.25\n",
    "fast.csv": "time_s,x_m,y_m,z_m\n0,0,0,1.25\n0.05,0,0.3,1.25\n",
    "self.toml": f'second = "self.toml"\n{CAMERA}',
    "binned.yaml": f"{INFO}binning_x: 2\nbinning_y: 2\n",
    "part.yaml": f"{INFO}roi: {{width: 320, height: 240}}\n",
    "square.yaml": f"{INFO}roi: {{width: 480, height: 480}}\n",
    "fish.yaml": f"{INFO}fisheye_model: 1\n",
    "storage.yaml": '<?xml version="1.0"?><opencv_storage><image_width>640</image_width></opencv_storage>',
    "fine.yaml": INFO,
    "doubled.toml": 'width = 640\nintrinsics = "fine.yaml"\n',
    "twice.toml": FOUR_JOINTS + 'joint_names = ["a", "b", "c", "a"]\n',
    "torn.toml": FOUR_JOINTS + 'joint_names = ["a", "b", "c\\nd", "e"]\n',
    "again.yaml": f"{INFO}width: 320\n",
    "list.yaml": "kinematics:\n  - 1\n",
    "arm_mm.toml": "a = [0, -425]\nd = [0, 0]\nalpha = [0, 0]\njoint_lower = []\njoint_upper = []\njoint_speed = []\n",
    "no.fmu": "this is no archive",
    "test_taken.py": "mine",
    "no_fmu.toml": "[fmu]\nfile = 3\n",
}
WRONG: tuple[tuple[tuple[str, ...], str], ...] = (
    # names
    (("run", "--plant", "kinematik"), "unknown plant 'kinematik': did you mean 'kinematic'?"),
    (("run", "--plant", "fmu:"), "mapping . cannot be read"),
    (("run", "--plant", "fmu:none.toml"), "none.toml"),
    (("run", "--plant", "none.toml"), "mapping none.toml cannot be read: No such file"),
    (("run", "--plant", "no.fmu"), "fmu file no.fmu is not a zip archive"),
    (("run", "--plant", "fmu:no_fmu.toml"), "no_fmu.toml"),
    (("run", "--controller", "ukf_mfca"), "unknown controller 'ukf_mfca': did you mean 'ukf_mfac'?"),
    (("run", "--controller", "mfac"), "unknown controller 'mfac': it is a law and makes a pair, such as mfac+ukf"),
    (("run", "--controller", "kalman"), "'kalman': it is an estimator and makes a pair, such as mfac+kalman"),
    (("run", "--controller", "ukf+mfac"), "controller 'ukf+mfac': the law stands first: write mfac+ukf"),
    (("run", "--controller", "mfac+rsl"), "got 'rsl'; did you mean 'rls'?"),
    (("run", "--controller", "mfca+rls"), "got 'mfca'; did you mean 'mfac'?"),
    (("run", "--controller", "ukf_mfac", "--estimator", "ukf"), "law must be one of"),
    ((*RUN, "--task", "circel"), "unknown task 'circel': did you mean 'circle'?"),
    (("plants", "bulet"), "unknown plant 'bulet': did you mean 'bullet'?"),
    (("controllers", "rbf_pdi"), "unknown controller 'rbf_pdi': did you mean 'rbf_pid'?"),
    (("tasks", "exp22"), "unknown task 'exp22': did you mean 'exp2'?"),
    # commands and options
    (("rum",), "no such command 'rum'. Did you mean 'run'?; see servobench --help"),
    (("run", "--sed", "3"), "no such option: --sed (Possible options: --seed, --set); see servobench run --help"),
    (("run", "constant", "--controller", "rls"), "two controllers are named, constant and --controller rls; a run has"),
    (("tasks", "--robot", "ur10e"), "--robot shows the settings of one task"),
    (("tune", "--robot", "panda"), "tune has no --robot: methods are tuned on the UR5 alone"),
    (("tune", "--sensing", "pixel"), "tune has no --sensing: "),
    (("controllers", "--sensing", "pixel"), "controllers has no --sensing: "),
    (("check", "robot", "./mine.py"), "check needs a controller, or the word plant and a plant"),
    (("check", "plant"), "check plant needs a plant, such as servobench check plant ./cell.py"),
    (("statistics", "results", "--json", "--markdown"), "are ways to print the same; give one of them"),
    (("statistics", "results", "--latex", "--markdown"), "are ways to print the same; give one of them"),
    (("serve", "--address", "::1%none"), "RTDE port 30004 of ::1%none cannot be opened: Name or service not known"),
    (("serve", "--address", "robot"), "--address: 'robot' does not appear to be an IPv4 or IPv6 address"),
    (("new", "plant", "my_cell", "--aids"), "--aids are those of a controller; leave the option out for a plant"),
    (("new", "controller", "taken"), "test_taken.py exists already and is left as it is"),
    (("init", "file"), "file exists already and is left as it is; name another file"),
    (("init", "file/bench.toml"), "file/bench.toml cannot be written: Not a directory"),
    (("init", "none/bench.toml"), "none/bench.toml cannot be written: No such file or directory"),
    # mismatches
    ((*RUN, "--mismatch", "mild"), "'mild' is not known here; wanted one profile (none, factory, moderate"),
    ((*RUN, "--mismatch", "camera_rotaton=5deg"), "did you mean 'camera_rotation'?"),
    ((*RUN, "--mismatch", "links=5mm"), "links needs a magnitude with one of the units '%', none"),
    ((*RUN, "--mismatch", "links=100%"), "links must be at least 0 and below 100%, got 100%"),
    ((*RUN, "--mismatch", "links=5%+links=6%"), "'links=5%+links=6%' has the axis links twice; give it once"),
    ((*RUN, "--mismatch", "moderate+severe"), "'severe' is not known here; a profile stands first"),
    ((*RUN, "--mismatch", "moderate=2"), "the profile moderate has no magnitude"),
    ((*RUN, "--mismatch", "camera_rotation=200deg"), "camera_rotation must be at least 0 and at most 180deg, got"),
    (("run", "--controllers", "constant,rls"), "'constant,rls' names several, where one is wanted; compare takes"),
    (("run", "--task", "exp1,exp2"), "'exp1,exp2' names several, where one is wanted; compare takes"),
    ((*RUN, "--set", "sensing.latency=0.1"), "unknown section 'sensing': it is a setting of kinematic: write kin"),
    ((*RUN, "--latency", "0.1"), "run has no --latency: it is a setting, --set kinematic.sensing.latency=...; s"),
    ((*RUN, "--mismatch", "extreme"), "'extreme' is not known here; wanted one profile (none, factory"),
    ((*RUN, "--mismatch", "factory=none.yaml"), "calibration file none.yaml cannot be read"),
    ((*RUN, "--mismatch", "factory=list.yaml"), "list.yaml holds something that is not a number"),
    # settings
    ((*RUN, "--set", "kinematic"), "--set needs section.key=value, such as kinematic.lag=0.1; got 'kinematic'"),
    ((*RUN, "--set", "kinematc.lag=1"), "unknown section 'kinematc': did you mean 'kinematic'?"),
    ((*RUN, "--set", "kinematic.lga=1"), "kinematic has no setting 'lga': did you mean 'lag'?"),
    ((*RUN, "--set", "kinematic.latency=1"), "kinematic has no setting 'latency': did you mean 'sensing.latency'?"),
    ((*RUN, "--set", "kinematic.sensing=1"), "kinematic.sensing is a section of its own, got 1"),
    ((*RUN, "--set", "kinematic.sensing.drop_probability=1"), "drop_probability must be below 1, got 1"),
    ((*RUN, "--set", "constant.initial.source=prob"), "did you mean 'probe'?"),
    ((*RUN, "--set", "bullet.lag=0.1"), "--set bullet.lag=0.1: 'bullet' does not run here, so this has no effect"),
    ((*RUN, "--set", "ukf_mfac.law.gain=3"), "sections that run: run, kinematic, constant, exp2; settings"),
    ((*RUN, "--set", "circle.laps=3"), "'circle' does not run here"),
    ((*RUN, "--set", "run.period=0"), "run.period must be at least 0.0001, got 0"),
    ((*RUN, "--set", "run.period=125"), "run of 10 s, got 125 s; if 125ms or 125Hz is meant, write the unit, too"),
    ((*RUN, "--mismatch", "links=-5%"), "links has no sign, as each robot draws one where there is one; got '-5%'"),
    ((*RUN, "--sensing", "pixel:hands"), "unknown sensing 'pixel:hands': did you mean 'pixel:hand'?"),
    ((*RUN, "--sensing", "pixel", "--set", "kinematic.sensing.feature_noise=2"),
     "above a tenth of 320 px: a plain number is in metres; for pixels write 2px"),
    ((*RUN, "--set", "kinematic.sensing.feature_noise=2px"), "is 2px, but the features are in m; write it in m"),
    ((*RUN, "--robot", "arm_mm.toml"), "arm_mm.toml.a.1 must be at least -20, got -425; if -425mm is meant, write"),
    ((*RUN, "--set", "run.preview_time=60"), "run.preview_time must be no longer than the run of 10 s, got 60 s"),
    ((*RUN, "--set", "kinematic.sensing.outliers=20%", "--mismatch", "moderate+outliers=5%"),
     "kinematic.sensing.outliers is set, and the mismatch moderate+outliers=5% sets it, too; leave one out"),
    ((*RUN, "--set", "run.camera_moves_at=0.2"), "has no effect: no mismatch moves the camera"),
    ((*RUN, "--set", "kinematic.sensing.latency=5000"), "latency must be shorter than the run of 10 s, got 5000 s"),
    ((*RUN, "--set", "kinematic.command_delay=10"), "command_delay must be shorter than the run of 10 s, got 10 s"),
    ((*RUN, "--set", "kinematic.sensing.frame_period=20"), "frame_period must be shorter than the run of 10 s"),
    ((*RUN, "--set", "exp2.start=[9,0,0,0,0,0]"), "start must be within the joints' limits, -6.283 to 6.283"),
    ((*RUN, "--set", "exp2.target=[0,0,0,0,-7,0]"), "target must be within the joints' limits"),
    ((*RUN, "--set", "exp2.start=[1,2]"), "task exp2: its setting start must have shape (6,), got (2,)"),
    ((*RUN, "--config", "none.toml"), "configuration file none.toml cannot be read"),
    ((*RUN, "--config", "unknown_section.toml"), "unknown section 'kinematc': did you mean 'kinematic'?"),
    ((*RUN, "--config", "bad_value.toml"), "ukf_mpc.law.horizon_time must be above 0, got -1"),
    ((*RUN, "--config", "no_section.toml"), "'lag' stands outside a [section]"),
    # targets
    ((*RUN, "--task", "target", "--set", "target.target=[9,9,9]"), "(9, 9, 9) m in the camera frame, is"),
    ((*RUN, "--task", "target", "--set", "target.target=9,9,9"), "(9, 9, 9) m in the camera frame, is"),
    ((*RUN, "--task", "random", "--set", "random.shortest=100"), "apart by shortest = 100 m and above the table"),
    ((*RUN, "--task", "target", "--set", "target.target=[1,2]"), "target must have shape (3,), got (2,)"),
    ((*RUN, "--task", "circle", "--set", "circle.radius=30"), "m out of the arm's reach; for a target out of reach"),
    ((*RUN, "--task", "line", "--set", "line.end=[200,100,1200]"), "a point of its curve, (200, 100, 1200) m"),
    ((*RUN, "--task", "waypoints"), "task waypoints: it needs a CSV file, the setting waypoints.file"),
    ((*RUN, "--task", "waypoints", "--set", "waypoints.file=far.csv"), "task waypoints: a point of its curve"),
    ((*RUN, "--task", "waypoints", "--set", "waypoints.file=text.csv"), "row 0: z_m must be a finite number, got 'far"),
    ((*RUN, "--task", "waypoints", "--set", "waypoints.file=backwards.csv"), "waypoint times must ascend"),
    ((*RUN, "--task", "waypoints", "--set", "waypoints.file=columns.csv"), "has no column time_s; it needs time_s"),
    ((*RUN, "--task", "waypoints", "--set", "waypoints.file=clock.csv"), "clock.csv begins at 1760000000 s; write"),
    ((*RUN, "--task", "waypoints", "--set", "waypoints.file=semicolons.csv"), "has ';' between its columns; write"),
    ((*RUN, "--task", "waypoints", "--set", "waypoints.file=decimal_commas.csv"), "more cells than its header"),
    ((*RUN, "--task", "waypoints", "--set", "waypoints.file=empty.csv"), "waypoint file empty.csv is no table"),
    ((*RUN, "--config", "utf_16.toml"), "utf_16.toml is no text in UTF-8; save it in this encoding"),
    ((*RUN, "--task", "waypoints", "--set", "waypoints.file=no.csv"), "waypoint file no.csv cannot be read"),
    # lists, seeds and places
    ((*RUN, "--seed", "-1"), "seeds must name at least one seed, none of them negative"),
    ((*RUN, "--seed", "10000"), "seed 10000 cannot be used to judge: 10000:20000 are kept for tuning"),
    ((*RUN, "--seed", "two"), "invalid value for '--seed'"),
    ((*RUN, "--view"), "--view shows the plant bullet only, got --plant kinematic"),
    ((*RUN, "--out", "file/new"), "cannot be written: Not a directory"),
    ((*RUN, "--out", "caf\udce9"), "results folder caf\\udce9: its name is no utf-8; give another one as `out`"),
    ((*RUN, "--out", "full"), "results folder full exists already; give another one as `out`"),
    (("compare", "--controllers", "constant,constant"), "--controllers names constant twice"),
    (("compare", "--controllers", "constant,cnstant"), "unknown controller 'cnstant': did you mean 'constant'?"),
    (("compare", "--controllers", "constant,all"), "--controllers names constant twice"),
    ((*COMPARE, "--sensing", "position,position:fixed"), "is asked for twice: leave one out, or rename a file"),
    (("compare", "--tasks", ","), "--tasks is empty; valid: exp1"),
    ((*COMPARE, "--seeds", "3,1,3"), "seeds name 3 twice, got '3,1,3'"),
    ((*COMPARE, "--seeds", "many"), "seeds must be a count (5), a list (3,1,4) or a range (100:120), got 'many'"),
    ((*COMPARE, "--workers", "0"), "--workers"),
    ((*COMPARE, "--run-timeout", "0"), "--run-timeout"),
    ((*COMPARE, "--resume"), "--resume needs --out, the folder to continue in"),
    ((*COMPARE, "--debug", "--workers", "2"), "one by one in this process; leave --workers away"),
    ((*COMPARE, "--scheduler", "here"), "--scheduler needs an address such as tcp://127.0.0.1:8786, got 'here'"),
    ((*COMPARE, "--scheduler", "tcp://x:1", "--workers", "2"), "--workers are processes of this machine"),
    # sweeps
    ((*SWEEP, "--out", "full"), "exists already; give another one as `out`, or continue its batch with `resume`"),
    ((*SWEEP, "--vary", "camera_rotaton=0:30:10deg"), "unknown mismatch axis 'camera_rotaton' (a setting is as"),
    ((*SWEEP, "--vary", "lag=0.1,0.2"), "unknown mismatch axis 'lag' (a setting is as kinematic.lag): valid: backlash"),
    ((*SWEEP, "--vary", "links=5"), "links must be at least 0 and below 1, got 5; if 5% is meant, write the unit, too"),
    ((*SWEEP, "--vary", "links"), "--vary: links needs begin:end:step with a unit, such as links=0:30:10%"),
    ((*SWEEP, "--vary", "links=5/5%"), "twice"),
    ((*SWEEP, "--vary", "links=0:10:5%", "--mismatch", "links=5%"), "--vary links varies an axis that the mismatch"),
    ((*SWEEP, "--noise", "1,1"), "servobench: noise names 1 twice"),
    ((*SWEEP, "--noise", "-1"), "kinematic.sensing.noise_factor must be at least 0, got -1"),
    ((*SWEEP, "--period", "0"), "run.period must be at least 0.0001, got 0"),
    ((*SWEEP, "--period", "fast"), "run.period must be a number, got 'fast'"),
    ((*SWEEP, "--vary", "run.period=0:0.2:0.05"), "run.period must be at least 0.0001, got 0"),
    ((*SWEEP, "--vary", f"plant.lag=0.1,{10**400}"), "kinematic.lag must be finite, got inf"),
    ((*SWEEP, "--vary", "run.perod=0.1"), "run has no setting 'perod': did you mean 'period'?"),
    ((*SWEEP, "--vary", "plant.lag=1:0:0.5"), "--vary: the range '1:0:0.5' of plant.lag is empty"),
    ((*SWEEP, "--vary", "plant.lag="), "--vary: plant.lag needs values, such as run.period=0.02,0.05"),
    ((*SWEEP, "--vary", "plant.lag=0,0"), "--vary: plant.lag names 0 twice"),
    ((*SWEEP, "--vary", "plant.lag=80ms,0.08s"), "--vary: plant.lag names 0.08s twice"),
    ((*SWEEP, "--vary", "plant.lag=0.08,120ms"), "--vary: plant.lag mixes numbers and texts; write the unit with all"),
    ((*SWEEP, "--vary", "run.camera_moves_at=0.2,0.5"), "varying run.camera_moves_at has no effect: no mismatch moves"),
    ((*SWEEP, "--vary", "run.full_jacobian=true,false"), "varying run.full_jacobian has no effect: this command keeps"),
    ((*SWEEP, "--vary", "latency=0,0.1", "--latency", "0"), "--vary gives latency twice"),
    ((*SWEEP, "--vary", "latency=0", "--vary", "plant.sensing.latency=0"), "a setting is varied twice in latency"),
    ((*SWEEP, "--vary", "bullet.lag=0.1"), "the setting bullet.lag cannot be varied in runs of constant on kinematic"),
    ((*SWEEP, "--vary", "plant.sensing.jitter=0.1", "--mismatch", "jitter=50ms"), "the mismatch jitter=50ms sets it"),
    ((*SWEEP, "--set", "run.full_jacobian=true"), "has no effect: this command keeps no steps"),
    ((*SWEEP, "--period", "0.02", "--set", "run.period=0.05"), "has no effect: all runs vary run.period"),
    ((*SWEEP, "--latency", "0.1", "--set", "kinematic.sensing.latency=0"), "all runs vary kinematic.sensing.latency"),
    ((*SWEEP, "--latency", "0.9", "--set", "random.duration=0.5"), "latency must be shorter than the run of 0.5 s"),
    # results and pictures
    (("statistics", "no.fmu"), "no.fmu is not a results folder"),
    (("statistics", "results", "--against", "ukf_mfc"), "--against: unknown 'ukf_mfc': did you mean 'ukf_mfac'?"),
    (("statistics", "results", "--against", "A,B"), "--against: unknown 'A,B'"),
    (("statistics", "results", "--controllers", "ukf_mfac", "--against", "B"), "--against: unknown 'B'"),
    (("statistics", "results", "--names", "A"), "--names has 1 names for"),
    (("statistics", "results", "--names", "Q=quick"), "--names: unknown 'Q'"),
    (("statistics", "results", "--metric", "setling_time_s"), "did you mean 'settling_time_s'?"),
    (("collect", "none"), "none is not a results folder"),
    (("record", "results", "--kinds", "mp5"), "did you mean 'mp4'?"),
    (("record", "results"), "results holds 9 runs; name one with --run, such as"),
    (("record", "results", "--run", "nothing"), "results has no run 'nothing'"),
    # studies and tools
    (("analyse", "mfac"), "it is a law and makes a pair"),
    (("analyse", "pid+true", "--jacobian", "tru"), "'tru' is not one of 'true', 'nominal', 'estimated'"),
    (("robustness", "--out", "new", "--plant", "kinematic", "--set", "exp2.duration=3"), "'exp2' does not run here"),
    (("tune", "--controllers", "ukf_mfa"), "ukf_mfac"),
    (("tune", "--controllers", "ukf_mfac", "--robots", "0"), "robots must be"),
    (("train", "--set", "run.period=0.1"), "--set run.period=0.1 has no effect: networks depend on"),
    (("train", "--set", "rbfnn_mfac.law.k=0.1"), "has no effect: networks depend on rbfnn_mfac.training alone"),
    (("train", "--controller", "ukf_mpc"), "controller ukf_mpc has no networks to train"),
    (("train", "--controller", "rbfnn_mfac", "--set", "ukf_mfac.law.gain=1"), "'ukf_mfac' does not run here"),
    (("train", "--set", f"rbfnn_mfac.training.jacobian.samples={10**15}"), "the memory is not enough: Unable to"),
    (("fmu", "info", "no.fmu"), "no.fmu"),
    (("fmu", "validate", "none.fmu"), "none.fmu"),
    (("fmu", "export", "-o", "new.fmu", "--mismatch", "moderat"), "did you mean 'moderate'?"),
    (("fmu", "export", "-o", "new.fmu", "--fmi", "4"), "4"),
    (("fmu", "export", "-o", "new.fmu", "--platforms", "x86_64-linx"), "x86_64-linx"),
    (("suite", "--challenges", "severe,zeros45", "--controllers", "constant", "--out", "new", "--set",
      "lemniscate.lap_time=3"), "'lemniscate' does not run here"),
    (("suite", "--challenges", "severe,zeros45", "--controllers", "constant", "--out", "new", "--set",
      "circle.lap_time=-3"), "circle.lap_time must be above 0, got -3"),
    # a log beside a controller, and exports
    (("shadow",), "missing argument 'LOG', or --joints with a file of joints"),
    (("shadow", "none"), "none does not exist; wanted a results folder or a table"),
    (("shadow", "full"), "full is not a results folder"),
    (("shadow", "file", "--controller", "constant"), "file must be a results folder, or a table in .csv or .parquet"),
    (("shadow", "results"), "results holds 9 runs; name one with --run, such as"),
    (("shadow", "text.csv"), "text.csv does not say which controller to show it to; name one with --controller"),
    (("shadow", "columns.csv", "--controller", "constant"), "log columns.csv has no column time_s; it needs time_s"),
    (("shadow", "text.csv", "--controller", "constant", "--sensing", "pixl"), "did you mean 'pixel'?"),
    (("fmu", "export", "--controller", "rbf_pid", "--set", "rbf_pid.initial.source=probe", "-o", "new.fmu"),
     "controller 'rbf_pid' cannot be exported while it probes its initial Jacobian: set initial.source to nominal"),
    (("fmu", "export", "--controller", "ukf_mpc", "-o", "new.fmu"), "controller 'ukf_mpc' has no exported form: it "
     "holds something that is no formula"),
    (("fmu", "export", "--controller", "mfac+rls", "--sensing", "./untraced.py", "-o", "new.fmu"),
     "has no exported form with the sensing ./untraced.py: "),
    (("fmu", "export", "--controller", "calibrated", "-o", "new.fmu"), "it is given the true robot"),
    (("fmu", "export", "--controller", "ukf_mfak", "-o", "new.fmu"), "did you mean 'ukf_mfac'?"),
    (("fmu", "export", "-o", "full"), "'full' is a directory"),
    (("fmu", "export", "-o", "none/new.fmu"), "the folder none for new.fmu does not exist"),
    (("fmu", "ssp", "-o", "new.ssp"), "missing option '--controller'; see servobench fmu ssp --help"),
    (("export", "none", "--out", "new"), "none is not a results folder"),
    # names of other letters, nothing at all, the same thing twice, and paths of another kind
    ((*RUN, "--task", "krëis"), "unknown task 'krëis': valid:"),
    (("run", "--plant", "kinematic", "--controller", ""), "unknown controller '': valid:"),
    (("run", "constant", "--plant", ""), "unknown plant '': valid:"),
    ((*RUN, "--robot", ""), "unknown robot '': valid:"),
    ((*RUN, "--sensing", ""), "unknown sensing '': valid:"),
    ((*RUN, "--sensing", "pixel,stereo"), "'pixel,stereo' names several, where one"),
    ((*RUN, "--sensing", "./none.py"), "there is no file ./none.py"),
    ((*COMPARE, "--sensing", "pixel,pixel"), "--sensing names pixel twice"),
    ((*RUN, "--set", "kinematic.lag=1", "--set", "kinematic.lag=2"), "--set gives kinematic.lag twice"),
    ((*RUN, "--config", "full"), "configuration file full cannot be read"),
    ((*RUN, "--out", "a" * 300), "cannot be written: File name too long"),
    ((*RUN, "--run-memory", "-1GB"), "a memory limit is a size such as 500MB or 2GB"),
    (("new", "my_law"), "'my_law' is nothing to begin with; the command is servobench new controller NAME or"),
    # one line of each further refusal
    ((*SWEEP, "--vary", "links=30:0:10%"), "--vary: the range '30:0:10%' of links is empty"),
    ((*RUN, "--run-memory", "2 G B"), "a memory limit is a size such as 500MB or 2GB, or inf for none; got '2 G B'"),
    (("record", "results", "--kinds", ","), "--kinds is empty; valid: mp4"),
    (("tune", "--controllers", "mfac+rls"), "controller mfac+rls has no search space"),
    (("tune", "--controllers", ","), "--controllers is empty"),
    (("tune", "--robots", "209", "--offset", "7000"), "no room for 1672 seeds from 7000 on, of the trials, and 5016"),
    (("tune", "--robots", "8000"), "64000 seeds from 10000 on leave the tuning range 10000:20000"),
    # inputs that would lose data, or have no effect
    ((*RUN, "--robot", "twice.toml"), "each joint and feature needs a name of its own, got a, b, c, a"),
    ((*RUN, "--robot", "torn.toml"), r"cannot have the name 'c\nd', which is long or cannot be printed"),
    ((*RUN, "--sensing", "pixel", "--camera", "again.yaml"), "again.yaml is not valid YAML: width is there twice"),
    ((*RUN, "--sensing", "stereo", "--camera", "self.toml"), "is the second of a pair and must name no other"),
    ((*RUN, "--sensing", "pixel", "--camera", "binned.yaml"), "binning or a region (roi) leaves a part; write"),
    ((*RUN, "--sensing", "pixel", "--camera", "part.yaml"), "part.yaml is of a larger image"),
    ((*RUN, "--sensing", "pixel", "--camera", "square.yaml"), "square.yaml is of a larger image"),
    ((*RUN, "--sensing", "pixel", "--camera", "fish.yaml"), "must be of equidistant with k1, k2, k3, k4, got ()"),
    ((*RUN, "--sensing", "pixel", "--camera", "storage.yaml"), "storage.yaml is XML; wanted YAML"),
    ((*RUN, "--sensing", "pixel", "--camera", "doubled.toml"), "width is given here and by fine.yaml, its intrinsics"),
    ((*RUN, "--task", "waypoints", "--set", "waypoints.file=before.csv"), "times must ascend, the first one from 0 s"),
    ((*SWEEP, "--vary", "camera_rotation=0:180:50deg"), "must be begin:end:step, but its last step ends at 150"),
    ((*SWEEP, "--vary", "plant.lag=0:1:0.3"), "but its last step ends at 0.9"),
    (("shadow", "text.csv", "--controller", "constant", "--out", "./text.csv"), "text.csv is the log itself; name"),
    (("shadow", "text.csv", "--controller", "constant", "--run", "a"), "--run names a run of a results folder, and"),
    (("shadow", "text.csv", "--controller", "calibrated"), "is given the true robot, which text.csv does not"),
    (("fmu", "export", "-o", "arm"), "--output must end in .fmu, got arm"),
    (("fmu", "ssp", "-o", "loop", "--controller", "ukf_mfac"), "--output must end in .ssp, got loop"),
    (("fmu", "export", "-o", "x.fmu", "--controller", "broyden", "--seed", "3"), "--mismatch and --seed are for an"),
    (("fmu", "export", "-o", "x.fmu", "--mismatch", "outliers=40%"), "is exported without outliers: leave it out"),
    (("fmu", "export", "-o", "x.fmu", "--mismatch", "camera_move=9deg"), "an arm is exported without camera_move"),
    (("init", "-", "--plants", "kinematic", "--set", "bullet.lag=0.2"), "'bullet' does not run here"),
    (("init", "-", "--config", "bad_value.toml"), "ukf_mpc.law.horizon_time must be above 0, got -1"),
    (("fmu", "export", "-o", "x.fmu", "--controller", "rls", "--config", "bad_value.toml"), "must be above 0, got"),
    (("new", "controller", "numpy"), "a Python package is called numpy, which a file of this name would hide"),
    (("statistics", "results", "--metric", "seed"), "the table has no column of numbers 'seed'"),
    (("figures", "results", "--names", "A,A,B"), "--names has one name for several controllers: A, A, B"),
    (("record", "results", "--out", "film.avi"), "film.avi must be a folder, or one film that ends in .mp4 or .gif"),
)  # fmt: skip
POLAR = """
import numpy as np
from servobench.plant.cameras.setups import SensingSetup

def measure(points, optics):
    x, y, z = np.moveaxis(points[..., 0, 0, :], -1, 0)
    return np.stack([np.hypot(x + 1.0, y), {arc}, z], axis=-1)

POLAR = SensingSetup("polar", "the ball in polar coordinates", ("radius", "arc", "{last}"), "{unit}", measure)
"""
SETUPS = (  # file, its second feature, the name of its third, unit
    ("still.py", "0.0 * z", "depth", "m"),
    ("double.py", "1.0 * z", "depth", "m"),
    ("mm.py", "np.arctan(y / (x + 1.0))", "depth", "mm"),
    ("thousands.py", "1000.0 * y", "depth", "m"),
    ("named_twice.py", "y", "arc", "m"),
    ("untraced.py", "np.interp(y, [-9.0, 9.0], [-9.0, 9.0])", "depth", "m"),
)
UNLIKELY = (  # task, its settings, sensing, message
    ("circle", {"lap_time": 0.5}, "position", "the reference of the task circle moves at 3.7"),
    (
        "waypoints",
        {"file": "fast.csv"},
        "position",
        "the reference of the task waypoints moves at 6 m/s",
    ),
    (
        "waypoints",
        {"file": "slow.csv"},
        "position",
        "slow.csv take 6002 s; time_s is in s, not in ms",
    ),
    (
        "target",
        {"target": [0.0, 0.5, 1.3]},
        "position",
        "a target 160 mm from the arm's shoulder is within the arm",
    ),
    (
        "exp2",
        {},
        "./still.py",
        "sensing ./still.py: a feature stands still, or moves as another one does",
    ),
    (
        "exp2",
        {},
        "./double.py",
        "sensing ./double.py: a feature stands still, or moves as another one does",
    ),
    ("exp2", {}, "./mm.py", "mm/rad; is mm their unit?"),
    ("exp2", {}, "./thousands.py", "m/rad; is m their unit?"),
)


@pytest.fixture(scope="module")
def place(tmp_path_factory) -> Path:
    """A folder with files that are wrong in one way or another."""
    folder = tmp_path_factory.mktemp("wrong")
    for name, content in FILES.items():
        (folder / name).write_bytes(content if isinstance(content, bytes) else content.encode())
    (folder / "file").write_text("not a folder")
    for name, arc, last, unit in SETUPS:
        (folder / name).write_text(POLAR.format(arc=arc, last=last, unit=unit))
    (folder / "full").mkdir()
    (folder / "full" / "note.txt").write_text("mine")
    comparison(folder / "results")
    return folder


def contents(folder: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.parametrize(
    ("arguments", "words"), WRONG, ids=[" ".join(arguments) for arguments, _ in WRONG]
)
def test_a_wrong_input_is_one_right_line(place, monkeypatch, capsys, arguments, words):
    monkeypatch.chdir(place)
    before = contents(place)
    code, told = servobench(monkeypatch, *arguments), capsys.readouterr()
    assert code == 2, told
    assert told.err.startswith("servobench: ")
    assert told.err.count("\n") == 1
    assert words in told.err
    assert contents(place) == before


@pytest.mark.parametrize(("task", "settings", "sensing", "words"), UNLIKELY)
def test_an_unlikely_input_is_remarked_on_and_runs(
    place, monkeypatch, caplog, task, settings, sensing, words
):
    monkeypatch.chdir(place)
    remark.cache_clear()
    build_once(
        resolve(
            RunRequest("kinematic", "constant", task, "none", 0, sensing=sensing),
            Settings({task: settings}),
        )
    )
    assert words in caplog.text


@pytest.mark.parametrize("task", ["circle", "line", "lemniscate", "exp2", "target", "random"])
@pytest.mark.parametrize("sensing", ["position", "pixel", "stereo:hand"])
def test_a_task_as_it_comes_is_not_remarked_on(caplog, task, sensing):
    remark.cache_clear()
    build_once(
        resolve(RunRequest("kinematic", "constant", task, "severe", 0, sensing=sensing), Settings())
    )
    assert not caplog.text


@pytest.mark.parametrize(
    ("assignment", "extra", "words"),
    [
        ("kinematic.sensing.noise_offset=0.05", (),
         "noise_offset=0.05 has no effect while kinematic.sensing.noise is white"),
        ("kinematic.sensing.outlier_size=0.1", (), "has no effect while kinematic.sensing.outliers is 0.0"),
        ("kinematic.sensing.outlier_size=0.1", ("--mismatch", "outliers=20%"), ""),
        ("kinematic.sensing.skewness=0.5", (), "has no effect while kinematic.sensing.noise is white"),
        ("kinematic.sensing.skewness=0.5", ("--mismatch", "stable=1.5"), ""),
        ("constant.initial.given=[[1.0]]", (), "has no effect while constant.initial.source is nominal"),
        ("constant.initial.probe_step=0.1", (), "has no effect while constant.initial.source is nominal"),
        ("constant.aids.lag=0.1", (), "has no effect while constant.aids.response is ignored"),
        ("constant.aids.damping=0.1", (), "feedforward is False and constant.aids.posture is False and constant.aids."),
        ("constant.aids.damping=0.1", ("--set", "constant.aids.posture=true"), ""),
        ("constant.aids.feature_noise=0.01", (), "has no effect while constant.aids.delay is ignored and constant."),
        ("constant.aids.feature_noise=0.01", ("--set", "constant.aids.filter=true"), ""),
    ],
)  # fmt: skip
def test_a_setting_that_waits_for_another_is_remarked_on(
    place, monkeypatch, caplog, tmp_path, assignment, extra, words
):
    monkeypatch.chdir(place)
    remark.cache_clear()
    short = "--set", "exp2.duration=0.1", "--out", str(tmp_path / "out")
    assert servobench(monkeypatch, "sweep", "--plants", "kinematic", "--controllers", "constant", "--tasks", "exp2",
                      "--seeds", "1", "--workers", "1", "--set", assignment, *extra, *short) == 0  # fmt: skip
    assert words in caplog.text if words else not caplog.text


def test_a_set_up_whose_features_share_a_name_is_refused_with_its_line(
    refusal_of, place, monkeypatch
):
    monkeypatch.chdir(place)
    line = refusal_of(*RUN, "--sensing", "./named_twice.py")
    assert "named_twice.py:9: ValueError: each joint and feature needs a name of its own" in line


@pytest.mark.parametrize("evaluate_from", [-1.0, 2.0, 3.0])
def test_the_judged_part_of_a_task_is_within_its_run(evaluate_from):
    with pytest.raises(ValueError, match="evaluate_from must be in the run of 2 s, got"):
        Scenario(None, FixedPoint(np.zeros(3)), 2.0, evaluate_from)
