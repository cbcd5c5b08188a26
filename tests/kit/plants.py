"""Plant settings from flat keywords: those of the nested section `sensing` are sorted into it."""

from dataclasses import fields, replace

from servobench.plant.bench import SensingConfig


def configure(kind, **values):
    """Return settings of class `kind`; what is not given has its default."""
    default = kind()
    names = {field.name for field in fields(SensingConfig)}
    sensing = replace(default.sensing, **{name: value for name, value in values.items() if name in names})
    rest = {name: value for name, value in values.items() if name not in names}
    return replace(default, sensing=sensing, **rest)
