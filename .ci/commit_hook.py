"""Build hook of hatchling: writes the commit of the checkout into wheels and source distributions.

A wheel that is built from a source distribution has the commit of that one.
"""

import shutil
import sys
import tempfile
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / ".package"))

from servobench.harness.config.installation import COMMIT_FILE, CommitUnknown, read_commit  # noqa: E402

FOLDERS = {"wheel": "servobench", "sdist": ".package/servobench"}  # of the package within each


class CommitHook(BuildHookInterface[Any]):
    """Adds a file with the commit, where it is known."""

    PLUGIN_NAME = "custom"
    _folder = ""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Write the file; an editable installation asks git itself."""
        if version == "editable":
            return
        try:
            commit = read_commit(ROOT)
        except CommitUnknown:
            return
        if commit is None:
            return
        self._folder = tempfile.mkdtemp(prefix="servobench-commit-")
        file = Path(self._folder) / COMMIT_FILE
        file.write_text(commit, encoding="ascii")
        build_data["force_include"][str(file)] = f"{FOLDERS[self.target_name]}/{COMMIT_FILE}"

    def finalize(self, version: str, build_data: dict[str, Any], artifact_path: str) -> None:
        """Remove the file, which has been copied."""
        del version, build_data, artifact_path
        if self._folder:
            shutil.rmtree(self._folder)
