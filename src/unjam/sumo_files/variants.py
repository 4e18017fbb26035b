"""Variants of a user network with other vehicle types and more or less traffic, as new files."""

import os
from collections.abc import Mapping
from pathlib import Path
from xml.sax.saxutils import quoteattr

from unjam.errors import invalid_value
from unjam.files import atomic_write, to_json
from unjam.processes import PrivateFolder
from unjam.sumo_files import SumoFiles, write_harmless_copy

TypeChanges = Mapping[str, Mapping[str, str]]  # attributes of vehicle types, by id


def write_variant(files: SumoFiles, types: TypeChanges, scale: float, path: Path) -> Path:
    """Write a variant of a network's files into the folder of `path`, with the configuration at `path`; return `path`.

    `types` are attributes to set in vehicle types, by id; `scale` multiplies the configuration's scale. Raise
    `InputError` if a file is broken or too large, or the configuration's scale is not a number.
    """
    folder, old_scale = path.parent, files.options.get("scale", "1")
    try:
        new_scale = float(old_scale) * scale
    except ValueError:
        raise invalid_value(f"{files.path.name}: scale", old_scale, "a number") from None
    names: dict[str, list[str]] = {"additional-files": [], "route-files": [], "weight-files": []}
    undefined = {name: types[name] for name in types if "id" not in files.types[name]}
    if undefined:  # SUMO's default types, which must be defined before a vehicle has them
        elements = (f"<vType {_xml_attributes({'id': name, **changes})}/>" for name, changes in undefined.items())
        names["additional-files"].append("types.add.xml")
        atomic_write(folder / "types.add.xml", f"<additional>{''.join(elements)}</additional>\n")
    with PrivateFolder() as private:
        copy, changes = Path(private) / "copy.xml", Path(private) / "types.json"
        atomic_write(changes, to_json(types))
        originals = files.additional_files, files.route_files, files.weight_files
        for option, kind, paths in zip(names, ("add", "rou", "weights"), originals, strict=True):
            for index, original in enumerate(paths):
                names[option].append(f"{index}.{kind}.xml")
                write_harmless_copy(original, copy, types=changes)
                atomic_write(folder / names[option][-1], copy.read_bytes())
    values = {
        "net-file": os.path.relpath(files.network.resolve(), folder.resolve()),
        **{option: ",".join(files_of_option) for option, files_of_option in names.items() if files_of_option},
        **files.options,
        "step-length": f"{files.step:g}",
        "scale": f"{new_scale:.6g}",
    }
    lines = [f"    <{name} {_xml_attributes({'value': value})}/>" for name, value in values.items()]
    atomic_write(path, "\n".join(["<configuration>", *lines, "</configuration>", ""]))
    return path


def _xml_attributes(values: Mapping[str, str]) -> str:
    return " ".join(f"{name}={quoteattr(value)}" for name, value in values.items())
