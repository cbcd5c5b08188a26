"""The content of an FMU of any model, and how it is written: sources, libraries, description, documentation.

Equal inputs give equal bytes: no date, no path and no machine name enters the archive.
"""

import hashlib
import html
import re
import string
import tempfile
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from uuid import UUID

from servobench.fmus.compiler import Platforms, compile_library, library_files
from servobench.fmus.dialect import ExportDialect, export_dialect
from servobench.fmus.model_description import (
    REFERENCES,
    Description,
    write_build_description,
    write_description,
    write_references,
)
from servobench.fmus.reference import INPUT_FILE, OUTPUT_FILE
from servobench.fmus.sources import layout_header
from servobench.fmus.variables import Layout
from servobench.plant.contract.files import accessing, write_atomically

MACHINERY = "fmi"  # folder of the FMI functions, which serve every model
ZIP_EPOCH = (1980, 1, 1, 0, 0, 0)  # the earliest date that a zip archive can hold
UNIX = 3  # system of an entry in a zip archive, which says how its mode is to be read
PLACEHOLDER = "{token}"
RELATED_FILES = (
    (
        INPUT_FILE,
        "testcase",
        "Inputs of the reference run, each held over the step that begins at its time.",
    ),
    (
        OUTPUT_FILE,
        "result",
        "Outputs of the reference run, computed by an independent implementation.",
    ),
)


@dataclass(frozen=True)
class Product:
    """The content of an FMU."""

    fmi_version: int  # one of `EXPORTS`
    folder: str  # folder of the model below `fmus`, with model.c, model.h and license.txt
    core: str  # name of the generated C file and of its header in that folder
    source: str  # text of that C file
    constants: Mapping[str, float]  # for layout.h, beside sizes and offsets of the variables
    description: Description  # description of the model
    documentation: str  # HTML
    reference: tuple[str, str]  # text of the reference run's inputs and outputs

    @property
    def dialect(self) -> ExportDialect:
        """The names of its version of FMI."""
        return export_dialect(self.fmi_version)

    def sources(self) -> dict[str, str]:
        """Return the C files by their path in the archive, with a placeholder for the token."""
        described = self.description
        machinery = (
            "model_functions.h",
            "instance.h",
            "instance.c",
            "shared_functions.h",
            f"{self.dialect.names.prefix}.c",
        )
        texts = {name: committed(MACHINERY, name) for name in machinery}
        for each in (files("servobench.fmus") / self.folder).iterdir():
            if each.name.endswith((".c", ".h")):
                texts[each.name] = committed(self.folder, each.name)
        standard = files("fmpy") / "c-code"
        for name in self.dialect.headers:
            texts[name] = (standard / name).read_text(encoding="utf-8")
        texts[f"{self.core}.c"] = self.source
        texts["layout.h"] = layout_header(
            described.layout, described.start, self.constants, PLACEHOLDER
        )
        return {f"sources/{name}": text for name, text in texts.items()}

    def descriptions(self, token: str) -> dict[str, bytes]:
        """Return the XML files by their path in the archive."""
        description = write_description(self.description, self.dialect, token)
        contents = {"modelDescription.xml": description}
        if not self.dialect.describes_sources:
            contents["sources/buildDescription.xml"] = write_build_description(self.description)
        return contents

    def companions(self) -> dict[str, str]:
        """Return documentation, licence and reference run by their path in the archive."""
        inputs, outputs = self.reference
        related = []
        for file, role, text in RELATED_FILES:
            from_manifest = f"../{file.removeprefix('extra/')}"
            related.append((from_manifest, role, text))
        return {
            INPUT_FILE: inputs,
            OUTPUT_FILE: outputs,
            f"extra/{REFERENCES}/fmi-ls-manifest.xml": write_references(related).decode(),
            "documentation/index.html": self.documentation,
            "documentation/licenses/license.txt": committed("ur5_mismatched", "license.txt"),
        }

    def write(self, path: Path, platforms: Platforms) -> Path:
        """Write the FMU atomically.

        Args:
            path: the .fmu file; its folder must exist.
            platforms: to compile for.

        Returns:
            The path.

        Raises:
            CompilerMissing: no compiler for one of the platforms.
            CompilationFailed: a compiler rejected the sources.
        """
        texts = self.sources() | self.companions()
        contents = {name: text.encode() for name, text in texts.items()}
        token = _token(contents)
        layout_name = "sources/layout.h"
        contents[layout_name] = contents[layout_name].replace(PLACEHOLDER.encode(), token.encode())
        contents |= self.descriptions(token)
        contents |= self._libraries(contents, platforms)
        write_archive(path, contents)
        return path

    def _libraries(self, contents: Mapping[str, bytes], platforms: Platforms) -> dict[str, bytes]:
        """Return the libraries by their path in the archive, compiled from the sources among its files."""
        identifier = self.description.model_identifier
        with tempfile.TemporaryDirectory(prefix="servobench-export-") as name:
            folder = Path(name)
            (folder / "sources").mkdir()
            for inside, content in contents.items():
                if inside.startswith("sources/"):
                    (folder / inside).write_bytes(content)
            libraries = {}
            for target in platforms:
                library = folder / "library" / target.name / f"{identifier}{target.suffix}"
                compile_library(folder / "sources", self.description.sources, target, library)
                libraries[target] = library.read_bytes()
        return library_files(libraries, identifier, self.fmi_version)


def c_files(fmi_version: int, core: str) -> tuple[str, ...]:
    """Return the C files to compile, in order."""
    return (f"{export_dialect(fmi_version).names.prefix}.c", "model.c", "instance.c", f"{core}.c")


def committed(folder: str, name: str) -> str:
    """Return the text of a file of this package."""
    return (files("servobench.fmus") / folder / name).read_text(encoding="utf-8")


def documentation(folder: str, layout: Layout, **words: str) -> str:
    """Return the documentation of a model: its template with these words and a table of the variables."""
    rows = [
        f"<tr><td><code>{html.escape(group.name)}</code></td><td>{' × '.join(map(str, group.shape))}</td>"
        f"<td>{group.role}</td><td>{group.unit}</td><td>{html.escape(group.description)}</td></tr>"
        for group in layout.groups
    ]
    escaped = {name: html.escape(text) for name, text in words.items()}
    template = string.Template(committed(folder, "documentation.html"))
    return template.substitute(escaped, rows="\n".join(rows))


def word(text: str, otherwise: str) -> str:
    """Return a text as a word of C, which begins with `otherwise` where it does not begin with a letter."""
    plain = re.sub(r"[^A-Za-z0-9_]", "_", text)
    if plain[:1].isalpha():
        return plain
    return f"{otherwise}_{plain}"


def _token(contents: Mapping[str, bytes]) -> str:
    """Return a GUID that is a hash of everything in the FMU except its libraries."""
    digest = hashlib.sha256()
    for name in sorted(contents):
        digest.update(name.encode() + b"\0" + contents[name] + b"\0")
    return f"{{{UUID(digest.hexdigest()[:32])}}}"


def write_archive(
    path: Path, contents: Mapping[str, bytes], first: str = "modelDescription.xml"
) -> None:
    """Write files by their path in a zip archive, the `first` one first; atomically.

    Raises:
        ValueError: the folder does not exist, or takes no file.
    """

    def write(partial: Path) -> None:
        with zipfile.ZipFile(partial, "w") as archive:
            for inside in sorted(contents, key=lambda name: (name != first, name)):
                entry = zipfile.ZipInfo(inside, ZIP_EPOCH)
                entry.compress_type = zipfile.ZIP_DEFLATED
                entry.create_system = UNIX
                entry.external_attr = 0o644 << 16
                archive.writestr(entry, contents[inside], compresslevel=9)

    with accessing(path):
        write_atomically(path, write)
