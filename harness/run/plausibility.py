"""Whether the settings of a run are plausible together: times against its length, noise against the image.

Settings that are valid one by one and make no run together are refused, such as a time longer than the run.
"""

from servobench.harness.run.request import RunSettings
from servobench.plant.cameras.setups import SetupModel
from servobench.plant.contract.faults import ConfigurationError, configuration_errors
from servobench.plant.contract.sensing import SensingConfig
from servobench.plant.contract.settings import likely_meant, remark
from servobench.plant.robot.hand_eye import RobotModel

# Noise, steps and outliers are remarked on beyond this share of an image, or of a metre.
MAX_EXTENT = 0.1  # [1]


def check_times(run: RunSettings, plant: str, config: object, duration: float) -> None:
    """Refuse times that are longer than a run, so that they never end in it.

    Args:
        run: its section `run`.
        plant: name of its plant.
        config: settings of the plant.
        duration: its length [s].

    Raises:
        ConfigurationError: names the first such time.
    """
    whole = f"the run of {duration:g} s"
    times = {"run.period": run.period}
    for name in ("command_delay", "lag"):
        times[f"{plant}.{name}"] = getattr(config, name, 0.0)
    sensing = getattr(config, "sensing", None)
    if isinstance(sensing, SensingConfig):
        for name in ("latency", "jitter", "frame_period", "latency_swing"):
            times[f"{plant}.sensing.{name}"] = getattr(sensing, name)
        late = [begin for begin, _ in sensing.occlusion_windows if begin >= duration]
        if late:
            raise ConfigurationError(
                f"{plant}.sensing.occlusion_windows must begin within {whole}, got {late[0]:g} s"
            )
    for name, time in times.items():
        if isinstance(time, float) and time > 0.0 and time >= duration:
            meant = likely_meant(time, "s", lambda other: other < duration)
            raise ConfigurationError(f"{name} must be shorter than {whole}, got {time:g} s{meant}")
    preview = run.preview_time
    if preview > max(duration, RunSettings().preview_time):
        raise ConfigurationError(
            f"run.preview_time must be no longer than {whole}, got {preview:g} s"
        )


def check_extents(plant: str, config: object, nominal: RobotModel | None) -> None:
    """Refuse noise, steps and outliers beyond an image, or a metre, and remark on those beyond a tenth of it.

    A plain number of a pixel's noise is one of metres and likely a mistake beyond a tenth.

    Args:
        plant: name of a plant.
        config: settings of the plant.
        nominal: the nominal robot with its cameras; None for a plant that brings its own.

    Raises:
        ConfigurationError: names the first such extent.
    """
    sensing = getattr(config, "sensing", None)
    if nominal is None or not isinstance(sensing, SensingConfig):
        return
    unit = nominal.channel.unit
    whole = 1.0
    if unit == "px" and isinstance(nominal, SetupModel):
        whole = nominal.optics.size[0]
    with configuration_errors(f"{plant}."):
        extents = sensing.extents(unit, nominal.noise_unit)
    if unit not in ("px", "m"):
        return
    for name, metres in extents._asdict().items():
        size = nominal.noise_unit * metres
        if size <= (whole if name == "outlier_size" else MAX_EXTENT * whole):
            continue
        words = f"{plant}.sensing.{name} is {size:.4g} {unit}, above a tenth of {whole:g} {unit}"
        given = getattr(sensing, name)
        plain = given == metres
        if plain and unit == "px":
            raise ConfigurationError(
                f"{words}: a plain number is in metres; for pixels write {given:g}px"
            )
        if size <= whole:
            remark(words)
            continue
        meant = ""
        if plain:
            meant = likely_meant(metres, "m", lambda other: other <= MAX_EXTENT * whole)
        raise ConfigurationError(words + meant)
