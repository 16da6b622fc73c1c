"""Connection strings: their forms, and the errors of invalid ones."""

import pytest

from glstar.errors import ConfigError
from glstar.link import Endpoint


@pytest.mark.parametrize(
    ("typed", "device", "baud"),
    [
        ("/dev/ttyUSB0", "/dev/ttyUSB0", 57600),
        ("/dev/ttyUSB0,115200", "/dev/ttyUSB0", 115200),
        ("/dev/serial/by-id/usb-Holybro_H7-if00", "/dev/serial/by-id/usb-Holybro_H7-if00", 57600),
        (" COM14,57600 ", "COM14", 57600),
        (r"\\.\COM14", r"\\.\COM14", 57600),
        ("serial:///dev/ttyUSB0:921600", "/dev/ttyUSB0", 921600),
        ("serial:/dev/ttyUSB0,38400", "/dev/ttyUSB0", 38400),
        ("serial://COM14:57600", "COM14", 57600),
    ],
)
def test_a_serial_port_is_named_with_or_without_its_rate(typed: str, device: str, baud: int) -> None:
    endpoint = Endpoint.parse(typed)

    assert (endpoint.kind, endpoint.device, endpoint.baud) == ("serial", device, baud)
    assert (endpoint.host, endpoint.port) == ("", 0)


@pytest.mark.parametrize(
    ("typed", "kind", "host", "port"),
    [
        ("udpin:0.0.0.0:14550", "udpin", "0.0.0.0", 14550),
        ("udpout:192.168.1.7:14551", "udpout", "192.168.1.7", 14551),
        ("udp:127.0.0.1:14560", "udpin", "127.0.0.1", 14560),
        ("udp://127.0.0.1:14560", "udpin", "127.0.0.1", 14560),
        ("udp://@192.168.1.7:14560", "udpout", "192.168.1.7", 14560),
        ("tcp:127.0.0.1:5762", "tcp", "127.0.0.1", 5762),
        ("tcp://sitl.local", "tcp", "sitl.local", 5760),
        ("tcpin:0.0.0.0:5760", "tcpin", "0.0.0.0", 5760),
        ("udpin:[::1]:14550", "udpin", "::1", 14550),
    ],
)
def test_a_network_link_is_named_in_the_forms_of_mavproxy_mavsdk_and_mavros(
    typed: str, kind: str, host: str, port: int
) -> None:
    endpoint = Endpoint.parse(typed)

    assert (endpoint.kind, endpoint.host, endpoint.port) == (kind, host, port)


@pytest.mark.parametrize("typed", ["udp:", "udpin::14550", "udp:14550", "udp://:14550", "tcpin:", "tcpin:5760"])
def test_listening_without_an_address_is_local(typed: str) -> None:
    assert Endpoint.parse(typed).host == "127.0.0.1"


@pytest.mark.parametrize(
    ("typed", "words"),
    [
        ("", "needs a name"),
        ("/dev/ttyUSB0,fast", "fast is no baud rate"),
        ("/dev/ttyUSB0,", "nothing is no baud rate"),
        ("serial:", "names no serial port"),
        ("flight.tlog", "is no link"),
        ("foo:bar", "is no link"),
        ("upd:14550", "did you mean udp:14550?"),
        ("127.0.0.1:14550", "udpin:127.0.0.1:14550 listens for UDP"),
        ("tcp:", "has no host"),
        ("udpout::14550", "has no host"),
        ("tcp:sitl:99999", "99999 is no port"),
        ("udp:::1", "in brackets"),
        ("udp://0.0.0.0:1@host:2", "not both at once"),
        ("mcast:", "forward a copy"),
    ],
)
def test_invalid_connection_strings_are_refused_with_advice(typed: str, words: str) -> None:
    with pytest.raises(ConfigError) as refusal:
        Endpoint.parse(typed)

    assert words in str(refusal.value)
    assert "\n" not in str(refusal.value)


def test_only_a_radio_is_bounded_by_its_baud_rate() -> None:
    assert Endpoint.parse("/dev/ttyUSB0,57600").bytes_per_s == 5760
    assert Endpoint.parse("/dev/ttyACM0,57600").bytes_per_s is None
    assert Endpoint.parse("udp:14550").bytes_per_s is None
