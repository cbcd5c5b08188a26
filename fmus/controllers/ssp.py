"""Writes a plant, a controller and their connections as one file of SSP 1.0 (System Structure and Parameterization)."""

import tempfile
import xml.etree.ElementTree as ET
from collections.abc import Mapping
from pathlib import Path

from servobench.fmus.compiler import Platforms
from servobench.fmus.controllers.export import COMMAND, FEATURE, POSITION, SEEN
from servobench.fmus.model_description import UNITS, exporter, xml_bytes
from servobench.fmus.product import Product, write_archive
from servobench.fmus.variables import BALL, INPUT

SSD = "http://ssp-standard.org/SSP1/SystemStructureDescription"
SSC = "http://ssp-standard.org/SSP1/SystemStructureCommon"
STRUCTURE = "SystemStructure.ssd"
PLANT = "plant"
CONTROLLER = "controller"


def write_loop(
    path: Path, plant: Product, controller: Product, platforms: Platforms, stop: float
) -> Path:
    """Write the closed loop of two products of FMI 2.

    Args:
        path: the .ssp file; its folder must exist.
        plant: an arm.
        controller: of that arm.
        platforms: to compile for.
        stop: of the default experiment [s].

    Returns:
        The path.

    Raises:
        ValueError: an FMU cannot be compiled, or the folder takes no file.
    """
    products = {PLANT: plant, CONTROLLER: controller}
    contents = {STRUCTURE: structure(products, stop)}
    with tempfile.TemporaryDirectory(prefix="servobench-ssp-") as folder:
        for name, product in products.items():
            fmu = product.write(Path(folder) / f"{name}.fmu", platforms)
            contents[f"resources/{name}.fmu"] = fmu.read_bytes()
    write_archive(path, contents, STRUCTURE)
    return path


def structure(products: Mapping[str, Product], stop: float) -> bytes:
    """Return the description of the system: components with the connectors in use, and the connections."""
    root = ET.Element(
        "ssd:SystemStructureDescription",
        {
            "xmlns:ssc": SSC,
            "xmlns:ssd": SSD,
            "name": "loop",
            "version": "1.0",
            "generationTool": exporter(),
        },
    )
    groups = {name: product.description.layout.by_name for name, product in products.items()}
    feature = BALL if BALL in groups[PLANT] else FEATURE
    measured = (("encoder_position", POSITION), (feature, FEATURE), (SEEN, SEEN))
    wires = [((PLANT, own), (CONTROLLER, wanted)) for own, wanted in measured]
    wires.append(((CONTROLLER, COMMAND), (PLANT, COMMAND)))
    ends = [(side, groups[side][name]) for start, end in wires for side, name in (start, end)]
    system = ET.SubElement(root, "ssd:System", name="loop")
    elements = ET.SubElement(system, "ssd:Elements")
    for side in products:
        source = {"source": f"resources/{side}.fmu", "type": "application/x-fmu-sharedlibrary"}
        component = ET.SubElement(elements, "ssd:Component", {"name": side, **source})
        connectors = ET.SubElement(component, "ssd:Connectors")
        for group in dict.fromkeys(group for own, group in ends if own == side):
            for scalar in group.scalar_names():
                kind = "input" if group.role == INPUT else "output"
                connector = ET.SubElement(connectors, "ssd:Connector", name=scalar, kind=kind)
                ET.SubElement(connector, "ssc:Real", unit=group.unit)
    connections = ET.SubElement(system, "ssd:Connections")
    for (start, first), (end, second) in wires:
        pairs = zip(
            groups[start][first].scalar_names(), groups[end][second].scalar_names(), strict=True
        )
        for one, other in pairs:
            names = {
                "startElement": start,
                "startConnector": one,
                "endElement": end,
                "endConnector": other,
            }
            ET.SubElement(connections, "ssd:Connection", names)
    units = ET.SubElement(root, "ssd:Units")
    for name in sorted({group.unit for _, group in ends}):
        unit = ET.SubElement(units, "ssc:Unit", name=name)
        ET.SubElement(unit, "ssc:BaseUnit", UNITS.get(name, {}))
    ET.SubElement(root, "ssd:DefaultExperiment", startTime="0", stopTime=repr(stop))
    return xml_bytes(root)
