"""A network written again: other types, more or less traffic, and the user's own files as they were."""

from pathlib import Path

import pytest

from tests.sumo_files.test_sumo_files import configuration
from unjam.errors import InputError
from unjam.sumo_files import read_sumo_files
from unjam.sumo_files.variants import write_variant

ROUTES = (
    '<routes><vTypeDistribution id="all"><vType id="car" tau="1" length="4"/><vType id="van"/>'
    '</vTypeDistribution><vehicle id="v" type="all"/><vehicle id="w"/></routes>'
)


def write_changed_variant(
    folder: Path, types: dict[str, dict[str, str]], scale: float, inside: str = "", routes: str = ROUTES
) -> Path:
    """A variant of a network, next to the original."""
    (folder / "mine").mkdir()
    (folder / "new").mkdir()
    files = read_sumo_files(configuration(folder / "mine", inside, routes=routes))
    return write_variant(files, types, scale, folder / "new" / "other.sumocfg")


def test_types_are_changed_wherever_they_are_defined(tmp_path: Path) -> None:
    path = write_changed_variant(tmp_path, {"car": {"tau": "1.5"}, "DEFAULT_VEHTYPE": {"accel": "2"}}, 1.0)
    found = read_sumo_files(path)
    assert found.types["car"] == {"id": "car", "tau": "1.5", "length": "4"}
    assert found.types["van"] == {"id": "van"}
    assert found.types["DEFAULT_VEHTYPE"] == {"id": "DEFAULT_VEHTYPE", "accel": "2"}
    assert found.used_types == {"car", "van", "DEFAULT_VEHTYPE"}


def test_changed_attributes_replace_those_of_nested_models(tmp_path: Path) -> None:
    nested = '<carFollowing-IDM tau="1" accel="2"/>'
    routes = (
        f'<routes><vType id="car">{nested}</vType><vTypeDistribution id="all"><vType id="van">{nested}</vType>'
        '</vTypeDistribution><vehicle id="v" type="car"/><vehicle id="w" type="van"/></routes>'
    )
    path = write_changed_variant(tmp_path, {"car": {"tau": "1.5"}}, 1.0, routes=routes)
    found = read_sumo_files(path)
    assert (found.types["car"]["tau"], found.types["car"]["accel"]) == ("1.5", "2")
    assert (found.types["van"]["tau"], found.types["van"]["accel"]) == ("1", "2")
    written = (path.parent / "0.rou.xml").read_text()
    assert '<carFollowing-IDM accel="2">' in written
    assert nested[:-2] in written


def test_the_network_and_the_users_files_are_unchanged(tmp_path: Path) -> None:
    path = write_changed_variant(tmp_path, {"car": {"tau": "1.5"}}, 1.0)
    assert read_sumo_files(path).network.resolve() == (tmp_path / "mine" / "road.net.xml").resolve()
    assert (tmp_path / "mine" / "road.rou.xml").read_text() == ROUTES
    assert sorted(file.name for file in path.parent.iterdir()) == ["0.rou.xml", "other.sumocfg"]


def test_times_and_harmless_options_stay_and_the_scale_is_multiplied(tmp_path: Path) -> None:
    inside = '<begin value="10"/><end value="100"/><step-length value="0.5"/><scale value="2"/>'
    path = write_changed_variant(tmp_path, {}, 0.75, inside + '<fcd-output value="big.xml"/>')
    found = read_sumo_files(path)
    assert (found.begin, found.end, found.step) == (10.0, 100.0, 0.5)
    assert float(found.options["scale"]) == 1.5
    assert found.dropped_items == ()


@pytest.mark.parametrize("text", ["tau<5", 'a"b&c'])
def test_special_characters_in_attributes_are_quoted(text: str, tmp_path: Path) -> None:
    path = write_changed_variant(tmp_path, {"car": {"imgFile2": text}, "DEFAULT_VEHTYPE": {"x": text}}, 1.0)
    found = read_sumo_files(path).types
    assert found["car"]["imgFile2"] == found["DEFAULT_VEHTYPE"]["x"] == text


def test_a_scale_that_is_not_a_number_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"road\.sumocfg: scale: 'much' is not allowed; allowed: a number"):
        write_changed_variant(tmp_path, {}, 1.0, '<scale value="much"/>')


def test_a_file_that_has_become_broken_is_reported(tmp_path: Path) -> None:
    files = read_sumo_files(configuration(tmp_path))
    (tmp_path / "road.rou.xml").write_text("<routes><vTyp")
    with pytest.raises(InputError, match=r"road\.rou\.xml: cannot be read"):
        write_variant(files, {}, 1.0, tmp_path / "other.sumocfg")
    assert not (tmp_path / "other.sumocfg").exists()


def test_included_types_are_changed_and_weights_of_edges_are_kept(tmp_path: Path) -> None:
    mine, new = tmp_path / "mine", tmp_path / "new"
    mine.mkdir()
    new.mkdir()
    (mine / "types.xml").write_text('<routes><vType id="car" tau="1"/></routes>')
    (mine / "w.xml").write_text('<weights><edge id="a" traveltime="9"/></weights>')
    routes = '<routes><include href="types.xml"/><vehicle id="v" type="car"/></routes>'
    files = read_sumo_files(configuration(mine, '<w value="w.xml"/>', routes=routes))
    found = read_sumo_files(write_variant(files, {"car": {"tau": "1.5"}}, 1.0, new / "other.sumocfg"))
    assert found.types["car"] == {"id": "car", "tau": "1.5"}
    assert [path.read_text() for path in found.weight_files] == [
        '<weights><edge id="a" traveltime="9"></edge></weights>'
    ]
