"""Commands whose parameters are dataclasses: each field of these is an option."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields, is_dataclass
from functools import wraps
from inspect import Parameter, Signature, signature
from typing import Any, get_type_hints


def grouped(command: Callable[..., None]) -> Callable[..., None]:
    """Return a command that has, for each parameter that is a dataclass, the fields of this class as options."""
    hints = get_type_hints(command, include_extras=True)
    groups: dict[str, Any] = {name: hint for name, hint in hints.items() if is_dataclass(hint)}
    parameters = []
    for name, parameter in signature(command).parameters.items():
        if name in groups:
            own = get_type_hints(groups[name], include_extras=True)
            options: list[tuple[str, Any, Any]] = [
                (each.name, each.default, own[each.name]) for each in fields(groups[name])
            ]
        else:
            options = [(name, parameter.default, hints[name])]
        parameters += [Parameter(key, Parameter.KEYWORD_ONLY, default=default, annotation=hint)
                       for key, default, hint in options]  # fmt: skip

    @wraps(command)
    def call(**values: Any) -> None:  # noqa: ANN401 - those of the options
        from servobench.harness.config.registry import offering

        for name, group in groups.items():
            values[name] = group(**{each.name: values.pop(each.name) for each in fields(group)})
        with offering():  # a user's own controllers have their names for as long as the command takes
            command(**values)

    vars(call).update(
        __signature__=Signature(parameters), __annotations__={each.name: each.annotation for each in parameters}
    )
    return call
