import gzip
import re
from contextlib import suppress
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from unjam.errors import InputError
from unjam.sumo_files import SumoFiles, read_sumo_files

NETWORK = '<net version="1.20"><edge id="a"/></net>'
ROUTES = '<routes><vType id="car" length="4"/><vehicle id="v" type="car"/></routes>'


def configuration(folder: Path, inside: str = "", network: str = NETWORK, routes: str = ROUTES) -> Path:
    """A configuration of a network and a file of routes, with more of its own."""
    (folder / "road.net.xml").write_text(network)
    (folder / "road.rou.xml").write_text(routes)
    path = folder / "road.sumocfg"
    files = '<net-file value="road.net.xml"/><route-files value="road.rou.xml"/>'
    path.write_text(f"<configuration><input>{files}</input>{inside}</configuration>")
    return path


def types_of(folder: Path, routes: str, inside: str = "") -> SumoFiles:
    return read_sumo_files(configuration(folder, inside, routes=f"<routes>{routes}</routes>"))


def test_files_times_and_types_are_what_the_configuration_says(tmp_path: Path) -> None:
    (tmp_path / "more.add.xml").write_text('<additional><vType id="bus" vClass="bus"/></additional>')
    path = tmp_path / "mine.sumocfg"
    configuration(tmp_path)
    path.write_text(
        '<configuration><net-file value="road.net.xml"/><route-files value="road.rou.xml"/>'
        '<additional-files value="more.add.xml"/><begin value="10"/><end value="100.5"/>'
        '<step-length value="0.5"/></configuration>'
    )
    found = read_sumo_files(path)
    assert (found.path, found.network) == (path, tmp_path / "road.net.xml")
    assert found.additional_files == (tmp_path / "more.add.xml",)
    assert (found.begin, found.end, found.step) == (10.0, 100.5, 0.5)
    assert found.types == {"car": {"id": "car", "length": "4"}, "bus": {"id": "bus", "vClass": "bus"}} | {
        "DEFAULT_VEHTYPE": {}
    }
    assert found.used_types == {"car"}


def test_the_short_attribute_of_options_is_read(tmp_path: Path) -> None:
    path = configuration(tmp_path, '<step-length v="0.1"/>')
    path.write_text(path.read_text().replace("net-file value", "net-file v"))
    assert read_sumo_files(path).step == 0.1


def test_a_mesoscopic_simulation_is_refused(tmp_path: Path) -> None:
    assert read_sumo_files(configuration(tmp_path, '<mesosim value="false"/>')).dropped_items == ()
    with pytest.raises(InputError, match=r"road\.sumocfg: mesosim: true is not allowed; allowed: false"):
        read_sumo_files(configuration(tmp_path, '<mesosim value="true"/>'))


def test_names_of_files_can_have_spaces(tmp_path: Path) -> None:
    path = configuration(tmp_path)
    (tmp_path / "road.rou.xml").rename(tmp_path / "my road.rou.xml")
    (tmp_path / "other.rou.xml").write_text("<routes/>")
    path.write_text(path.read_text().replace("road.rou.xml", "my road.rou.xml, other.rou.xml"))
    assert read_sumo_files(path).route_files == (tmp_path / "my road.rou.xml", tmp_path / "other.rou.xml")


def test_missing_options_have_sumos_defaults(tmp_path: Path) -> None:
    found = read_sumo_files(configuration(tmp_path))
    assert (found.begin, found.end, found.step, found.additional_files) == (0.0, None, 1.0, ())


def test_short_names_of_options_are_understood(tmp_path: Path) -> None:
    configuration(tmp_path)
    path = tmp_path / "short.sumocfg"
    path.write_text('<configuration><net value="road.net.xml"/><routes value="road.rou.xml"/></configuration>')
    assert read_sumo_files(path).used_types == {"car"}


@pytest.mark.parametrize(
    ("text", "seconds"),
    [("90", 90.0), ("90.5", 90.5), ("1:30:00", 5400.0), ("00:01:30", 90.0), ("2:00:00:05", 172805.0)],
)
def test_times_can_have_hours_and_days(text: str, seconds: float, tmp_path: Path) -> None:
    found = read_sumo_files(configuration(tmp_path, f'<time><end value="{text}"/></time>'))
    assert found.end == seconds


def test_minus_one_is_no_end(tmp_path: Path) -> None:
    assert read_sumo_files(configuration(tmp_path, '<end value="-1"/>')).end is None


@pytest.mark.parametrize(
    ("option", "text"),
    [
        *(("end", text) for text in ("noon", "nan", "inf", "-5", "90:00", "1:2:3:4:5")),
        *(("begin", text) for text in ("1:xx:0", "nan", "-1")),
        *(("step-length", text) for text in ("0", "nan", "fast", "-1")),
    ],
)
def test_an_invalid_time_is_refused(option: str, text: str, tmp_path: Path) -> None:
    path = configuration(tmp_path, f'<{option} value="{text}"/>')
    with pytest.raises(InputError, match=f"road.sumocfg: {option}: '{text}' is not allowed; allowed: "):
        read_sumo_files(path)


def test_an_end_before_the_begin_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="end: 10 s is not allowed; allowed: after begin, 20 s"):
        read_sumo_files(configuration(tmp_path, '<begin value="20"/><end value="10"/>'))


def test_types_are_those_that_vehicles_trips_and_flows_have(tmp_path: Path) -> None:
    found = types_of(
        tmp_path,
        '<vType id="a"/><vType id="b"/><vType id="c"/><vType id="never"/>'
        '<vehicle id="1" type="a"/><trip id="2" type="b"/><flow id="3" type="c"/><trip id="4"/>'
        '<person id="5" type="walker"/>',
    )
    assert found.used_types == {"a", "b", "c", "DEFAULT_VEHTYPE"}
    assert set(found.types) == {"a", "b", "c", "never", "DEFAULT_VEHTYPE"}


def test_the_types_of_a_used_distribution_are_used(tmp_path: Path) -> None:
    found = types_of(
        tmp_path,
        '<vType id="c"/><vTypeDistribution id="inside"><vType id="a"/><vType id="b"/></vTypeDistribution>'
        '<vTypeDistribution id="named" vTypes="b c"/><vType id="d"/>'
        '<flow id="1" type="inside"/><flow id="2" type="named"/>',
    )
    assert found.used_types == {"a", "b", "c"}
    assert set(found.types) == {"a", "b", "c", "d", "DEFAULT_VEHTYPE"}


def test_a_distribution_can_name_other_types_and_distributions(tmp_path: Path) -> None:
    found = types_of(
        tmp_path,
        '<vType id="c"/><vTypeDistribution id="m"><vType refId="c" probability="1"/><vType id="a">'
        '<param key="k"/></vType></vTypeDistribution><vType id="never"/>'
        '<vTypeDistribution id="all" vTypes="m"/>'
        '<flow id="1" type="all"/><vType id="last"/>',
    )
    assert found.used_types == {"a", "c"}


def test_vehicles_can_use_distributions_of_another_file(tmp_path: Path) -> None:
    mixture = '<vTypeDistribution id="mix"><vType id="a"/><vType id="b"/></vTypeDistribution>'
    (tmp_path / "types.add.xml").write_text(f"<additional>{mixture}</additional>")
    inside = '<input><additional-files value="types.add.xml"/></input>'
    assert types_of(tmp_path, '<flow id="1" type="mix"/>', inside).used_types == {"a", "b"}
    (tmp_path / "types.add.xml").write_text('<additional><flow id="1" type="mix"/></additional>')
    (tmp_path / "road.sumocfg").unlink()
    assert types_of(tmp_path, mixture, inside).used_types == {"a", "b"}


def test_the_default_type_can_be_a_distribution(tmp_path: Path) -> None:
    found = types_of(
        tmp_path, '<vTypeDistribution id="DEFAULT_VEHTYPE"><vType id="a"/></vTypeDistribution><trip id="1"/>'
    )
    assert found.used_types == {"a"}


def test_compressed_files_are_read(tmp_path: Path) -> None:
    configuration(tmp_path)
    for name, content in (("road.net.xml", NETWORK), ("road.rou.xml", ROUTES)):
        (tmp_path / f"{name}.gz").write_bytes(gzip.compress(content.encode()))
    path = tmp_path / "zipped.sumocfg"
    path.write_text(
        '<configuration><net-file value="road.net.xml.gz"/><route-files value="road.rou.xml.gz"/></configuration>'
    )
    assert read_sumo_files(path).used_types == {"car"}


def test_a_changed_file_is_read_again(tmp_path: Path) -> None:
    path = configuration(tmp_path)
    assert read_sumo_files(path).used_types == {"car"}
    (tmp_path / "road.rou.xml").write_text('<routes><vehicle id="v" type="truck"/></routes>')
    assert read_sumo_files(path).used_types == {"truck"}


BROKEN = {
    "no network": ("", ROUTES, "<configuration/>", "road.sumocfg: it names no net-file"),
    "no version": ("<net><edge/></net>", ROUTES, "", "road.net.xml: the network has no version"),
    "another root": (ROUTES, ROUTES, "", "road.net.xml: it is not a SUMO network: it begins with <routes>"),
    "empty network": ("", ROUTES, "", "road.net.xml: cannot be read"),
    "network that is no XML": ("plain words", ROUTES, "", "road.net.xml: cannot be read"),
    "routes that are no XML": (NETWORK, "<routes><vehicle", "", "road.rou.xml: cannot be read"),
    "routes in an unknown encoding": (NETWORK, '<?xml version="1.0" encoding="klingon"?><routes/>', "", "read"),
    "emission class outside of SUMO": (
        *(NETWORK, '<routes><vType id="car" emissionClass="PHEMlight/../../x"/><vehicle id="v" type="car"/></routes>'),
        *("", "road.rou.xml: emissionClass: 'PHEMlight/../../x' is not allowed"),
    ),
    "types without id": (NETWORK, "<routes><vType/></routes>", "", "vType: an element without id is not allowed"),
    "too many types": (
        *(NETWORK, "<routes>" + "".join(f'<vType id="{number}"/>' for number in range(100_001)) + "</routes>", ""),
        "vType: type '100000' is not allowed; allowed: at most 100,000 vehicle types",
    ),
    "no vehicles": (NETWORK, "<routes/>", "", "road.sumocfg: its route and additional files have no vehicle"),
    "configuration that is no XML": (NETWORK, ROUTES, "<configuration>", "road.sumocfg: cannot be read"),
}


@pytest.mark.parametrize("name", BROKEN)
def test_a_broken_file_is_reported_in_one_line(name: str, tmp_path: Path) -> None:
    network, routes, instead, words = BROKEN[name]
    path = configuration(tmp_path, network=network, routes=routes)
    if instead:
        path.write_text(instead)
    with pytest.raises(InputError, match=re.escape(words)) as caught:
        read_sumo_files(path)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", ["road.net.xml", "road.rou.xml", "road.sumocfg"])
def test_a_missing_file_is_named(name: str, tmp_path: Path) -> None:
    path = configuration(tmp_path)
    (tmp_path / name).unlink()
    with pytest.raises(InputError, match=f"{re.escape(name)}': there is no such file"):
        read_sumo_files(path)


@pytest.mark.parametrize("keep", [0, 5, 20, 45])
def test_a_truncated_compressed_file_is_reported(keep: int, tmp_path: Path) -> None:
    path = configuration(tmp_path)
    (tmp_path / "road.net.xml.gz").write_bytes(gzip.compress(NETWORK.encode())[:keep])
    path.write_text(path.read_text().replace("road.net.xml", "road.net.xml.gz"))
    with pytest.raises(InputError, match="cannot be read"):
        read_sumo_files(path)


PIECES = """
<net/_version="1"/>/</net>/<routes>/</routes>/<vType_id="a"/<flow_type="a"/<vTypeDistribution/_vTypes="a_b"
<configuration>/</configuration>/<end_value="1:/<net-file_value="road.net.xml"/<route-files_value="road.rou.xml,
"/&/<!--/\x00/é/<?xml_/>
"""
SNIPPETS = [*PIECES.replace("\n", "/").replace("_", " ").split("/"), "/>", "/"]
"""of XML, to be put together at random"""


@pytest.mark.long
@settings(max_examples=50, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    name=st.sampled_from(["road.net.xml", "road.rou.xml", "road.sumocfg", "road.rou.xml.gz"]),
    content=st.one_of(
        st.lists(st.sampled_from(SNIPPETS), max_size=8).map(lambda pieces: "".join(pieces).encode()),
        st.binary(max_size=60),
        st.tuples(st.integers(0, 90), st.binary(max_size=4)),
    ),
)
def test_any_content_is_read_or_refused(name: str, content: bytes | tuple[int, bytes], tmp_path: Path) -> None:
    path = configuration(tmp_path)
    (tmp_path / "road.rou.xml.gz").write_bytes(gzip.compress(ROUTES.encode()))
    if name.endswith("gz"):
        path.write_text(path.read_text().replace("road.rou.xml", "road.rou.xml.gz"))
    whole = (tmp_path / name).read_bytes()
    if isinstance(content, tuple):
        place, other = content
        content = whole[:place] + other + whole[place + len(other) :]
    (tmp_path / name).write_bytes(content)
    with suppress(InputError):
        assert read_sumo_files(path).used_types


def test_a_truncated_network_is_reported_however_long_it_is(tmp_path: Path) -> None:
    network = '<net version="1.20">' + '<edge id="a"/>' * 20_000
    with pytest.raises(InputError, match=re.escape("road.net.xml: cannot be read: no element found")):
        read_sumo_files(configuration(tmp_path, network=network))
    assert read_sumo_files(configuration(tmp_path, network=network + "</net>")).used_types == {"car"}
