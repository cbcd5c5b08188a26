"""On what a setting depends, declared beside its field: with which settings of its class it has an effect.

    @settings
    class CameraSettings:
        \"\"\"Settings of a camera.\"\"\"

        delay: Literal["ignored", "identified", "given"] = "ignored"
        \"\"\"Whether the latency is compensated.\"\"\"
        latency: Annotated[Delay, Only(delay="given")] = 0.0
        \"\"\"[s] latency of the camera.\"\"\"

Remarks on a setting without effect and the last sentence of its meaning on the pages are made from the declaration.
"""

from dataclasses import is_dataclass
from functools import cache
from typing import Any, TypeVar, final, get_type_hints

from annotated_types import Gt

Mark = TypeVar("Mark")


@final
class Only:
    """Declares that a setting has an effect only while one of some others has a value that it needs.

    Each keyword is the name of another setting of the class: with the value that is needed, with a tuple of such
    values, or with a bound, `Gt(0.0)`.
    """

    def __init__(self, **needed: object) -> None:
        """Keep what is needed by setting."""
        self.needed = needed

    def __str__(self) -> str:
        """Return it as a sentence for the pages."""
        conditions = [_condition(name, wanted) for name, wanted in self.needed.items()]
        return f"Only with {', or '.join(conditions)}."

    def holds(self, settings: object) -> bool:
        """Return whether one of the settings of an object has a value that is needed."""
        return any(_fits(getattr(settings, name), wanted) for name, wanted in self.needed.items())


def _condition(name: str, wanted: object) -> str:
    """Return the words for a setting with a value that is needed; the name alone for one that is switched on."""
    setting = f"`{name}`"
    if wanted is True:
        return setting
    if isinstance(wanted, Gt):
        return f"{setting} above {wanted.gt:g}"
    if isinstance(wanted, tuple):
        *first, last = wanted
        return f"{setting} {', '.join(first)} or {last}"
    return f"{setting} {wanted}"


def _fits(value: Any, wanted: object) -> bool:  # noqa: ANN401 - any setting
    """Return whether a value is one that is needed."""
    if isinstance(wanted, Gt):
        return bool(value > wanted.gt)
    if isinstance(wanted, tuple):
        return value in wanted
    return bool(value == wanted)


@cache
def declared(kind: type, mark: type[Mark]) -> dict[str, Mark]:
    """Return the declarations of a type in the annotations of a settings class, by field in their order.

    Args:
        kind: the class; one that is no dataclass has none.
        mark: the type of the declarations, such as `Only`.
    """
    if not is_dataclass(kind):
        return {}
    found = {}
    for name, hint in get_type_hints(kind, include_extras=True).items():
        for each in getattr(hint, "__metadata__", ()):
            if isinstance(each, mark):
                found[name] = each
    return found


def reasons_for_no_effect(config: object, key: str) -> dict[str, object]:
    """Return the settings that leave another without effect, with their values by dotted key; none if it has an effect.

    Args:
        config: the settings of a section, those of its parts nested.
        key: dotted key of a setting among them.
    """
    *parts, name = key.split(".")
    beside: Any = config
    for part in parts:
        # The key may go on within a setting, such as a table of a user's.
        beside = getattr(beside, part, None)
    kind: Any = type(beside)
    only = declared(kind, Only).get(name)
    if only is None or only.holds(beside):
        return {}
    section = key.removesuffix(name)
    return {f"{section}{other}": getattr(beside, other) for other in only.needed}
