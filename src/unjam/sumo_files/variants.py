"""Variants of a user network with other vehicle types and more or less traffic, as new files."""

import os
from collections.abc import Mapping
from pathlib import Path
from xml.sax.saxutils import quoteattr

from unjam.errors import invalid_value
from unjam.files import atomic_write, to_json
from unjam.processes import PrivateFolder
from unjam.sumo_files import SumoFiles, write_harmless_copy

TypeChanges = Mapping[str, Mapping[str, str]]
"""attributes of vehicle types by id"""


def write_variant(files: SumoFiles, types: TypeChanges, scale: float, path: Path) -> Path:
    """Write a variant of a network's files into the folder of `path`, the configuration last; return `path`.

    The network file itself stays where it is, and none of the network's files is changed. Options and elements that
    write, listen or read other files are left out, as in unjam's own episodes. `types` are attributes to set in vehicle
    types, by id; `scale` is a factor on the number of vehicles, in addition to that of the configuration.

    Raise `InputError` if a file is broken or too large, or the configuration's scale is not a number, and `DiskError`
    if the disk is full or cannot be written.
    """
    folder, before = path.parent, files.options.get("scale", "1")
    try:
        scaled = float(before) * scale
    except ValueError:
        raise invalid_value(f"{files.path.name}: scale", before, "a number") from None
    names: dict[str, list[str]] = {"additional-files": [], "route-files": [], "weight-files": []}
    undefined = {name: types[name] for name in types if "id" not in files.types[name]}
    if undefined:  # SUMO's default type can be defined before any vehicle has it
        elements = (f"<vType {_xml_attributes({'id': name, **changes})}/>" for name, changes in undefined.items())
        names["additional-files"].append("types.add.xml")
        atomic_write(folder / "types.add.xml", f"<additional>{''.join(elements)}</additional>\n")
    with PrivateFolder() as private:
        copy, changes = Path(private) / "copy.xml", Path(private) / "types.json"
        atomic_write(changes, to_json(types))
        for option, kind, originals in (
            ("additional-files", "add", files.additional_files),
            ("route-files", "rou", files.route_files),
            ("weight-files", "weights", files.weight_files),
        ):
            for number, original in enumerate(originals):
                names[option].append(f"{number}.{kind}.xml")
                write_harmless_copy(original, copy, changes)
                atomic_write(folder / names[option][-1], copy.read_bytes())
    values = {
        "net-file": os.path.relpath(files.network.resolve(), folder.resolve()),
        **{option: ",".join(files_of_option) for option, files_of_option in names.items() if files_of_option},
        **files.options,
        "step-length": f"{files.step:g}",
        "scale": f"{scaled:.6g}",
    }
    lines = [f"    <{name} {_xml_attributes({'value': value})}/>" for name, value in values.items()]
    atomic_write(path, "\n".join(["<configuration>", *lines, "</configuration>", ""]))
    return path


def _xml_attributes(values: Mapping[str, str]) -> str:
    return " ".join(f"{name}={quoteattr(value)}" for name, value in values.items())
