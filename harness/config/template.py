"""A configuration file with every setting: its value, and as a comment its meaning, unit, range and default."""

from __future__ import annotations

import json
import re
import textwrap
from collections.abc import Mapping
from typing import Any

from servobench.harness.config.describe import Setting, describe_settings, toml

BARE_KEY = re.compile(r"[A-Za-z0-9_-]+")
WIDTH = 100  # characters of a line of comment
HEAD = """\
# Settings of servobench, for {use} and other commands.
# Each line has the value in use; leave out what you do not change. --set SECTION.KEY=VALUE changes one for one call.
"""


def configuration_file(
    sections: Mapping[str, Any], defaults: Mapping[str, Any], titles: Mapping[str, str], use: str
) -> str:
    """Return the text of a TOML file that sets every setting of `sections` to its value there.

    Args:
        sections: configuration dataclasses by section.
        defaults: the same where nothing is set.
        titles: one line about each section.
        use: how the file is used, for the first line.
    """
    parts = [HEAD.format(use=use)]
    for section, config in sections.items():
        settings = list(describe_settings(config))
        normal = {each.key: toml(each.value) for each in describe_settings(defaults[section])}
        for group in dict.fromkeys(["", *(each.group for each in settings)]):  # nested sections after their own
            lines = [_line(each, normal.get(each.key, "")) for each in settings if each.group == group]
            title = "" if group else _comment(titles[section])
            parts.append(f"{title}[{_key(section)}{'.' * bool(group)}{group}]\n{''.join(lines)}")
    return "\n".join(parts)


def _line(setting: Setting, default: str) -> str:
    """Return the comment and the line of a setting; one without a value is a comment, too."""
    value, unit = toml(setting.value), f"[{setting.unit}] " if setting.unit else ""
    facts = "; ".join(
        part for part in (setting.allowed, f"default {default}" if default else "unset by default") if part
    )
    words = f"{unit}{setting.meaning or setting.name}".rstrip(".")
    return _comment(f"{words} ({facts})") + (f"{setting.name} = {value}\n" if value else f"# {setting.name} =\n")


def _comment(text: str) -> str:
    lines = textwrap.wrap(text, WIDTH - 2, break_long_words=False, break_on_hyphens=False)
    return "".join(f"# {line}\n" for line in lines)


def _key(name: str) -> str:
    return name if BARE_KEY.fullmatch(name) else json.dumps(name, ensure_ascii=False)
