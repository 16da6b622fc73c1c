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


@pytest.mark.parametrize("baud", [1200, 12_500_000])
def test_a_baud_rate_is_between_1200_and_12_5_million(baud: int) -> None:
    assert Endpoint.parse(f"/dev/ttyUSB0,{baud}") == Endpoint(
        "serial", f"/dev/ttyUSB0,{baud}", device="/dev/ttyUSB0", baud=baud
    )
    beyond = 1199 if baud == 1200 else 12_500_001
    with pytest.raises(ConfigError) as refused:
        Endpoint.parse(f"/dev/ttyUSB0,{beyond}")
    advice = "radios are set to 57600, USB ports to 115200"
    assert str(refused.value) == f"/dev/ttyUSB0,{beyond}: {beyond} is no baud rate; {advice}"


@pytest.mark.parametrize(
    ("typed", "expected"),
    [
        ("tcp:h:1", Endpoint("tcp", "tcp:h:1", host="h", port=1)),
        ("tcpout:h:65535", Endpoint("tcp", "tcpout:h:65535", host="h", port=65535)),
        ("UDP:h", Endpoint("udpin", "UDP:h", host="h", port=14550)),
        ("tcpin::77", Endpoint("tcpin", "tcpin::77", host="127.0.0.1", port=77)),
        ("tcp:h:", Endpoint("tcp", "tcp:h:", host="h", port=5760)),
        ("udpout:[fe80::1]", Endpoint("udpout", "udpout:[fe80::1]", host="fe80::1", port=14550)),
        ("udp://h:5/", Endpoint("udpin", "udp://h:5/", host="h", port=5)),
    ],
)
def test_an_address_has_the_usual_port_unless_it_names_one(typed: str, expected: Endpoint) -> None:
    assert Endpoint.parse(typed) == expected


@pytest.mark.parametrize(
    ("typed", "message"),
    [
        ("tcp:h:0", "tcp:h:0: 0 is no port; ports are numbers from 1 to 65535, and usually 5760"),
        ("udp:h:65536", "udp:h:65536: 65536 is no port; ports are numbers from 1 to 65535, and usually 14550"),
        ("tcp:h:x", "tcp:h:x: x is no port; ports are numbers from 1 to 65535, and usually 5760"),
        ("udpout:", "udpout: has no host; write udpout:HOST:14550, such as udpout:127.0.0.1:14550"),
        ("udp:a:b:c", "udp:a:b:c: write an address with colons in brackets, such as [::1]:14550"),
        ("tcp:a@b", "tcp:a@b: only udp:// accepts an @; write tcp:HOST:PORT"),
        ("udp://a@b", "udp://a@b: listen (udpin:a) or send first (udpout:b); not both at once"),
    ],
)
def test_what_is_wrong_with_an_address_is_said_with_what_to_write(typed: str, message: str) -> None:
    with pytest.raises(ConfigError) as refused:
        Endpoint.parse(typed)
    assert str(refused.value) == message


@pytest.mark.parametrize(
    ("typed", "is_here"),
    [
        ("tcp:localhost", True),
        ("tcp:127.0.0.2", True),
        ("tcp:[::1]:5", True),
        ("tcp:10.0.0.9", False),
        ("tcp:glstar.local", False),
        ("udpin:0.0.0.0", False),
        ("/dev/ttyUSB0", False),
    ],
)
def test_only_loopback_stays_on_this_computer(typed: str, is_here: bool) -> None:
    assert Endpoint.parse(typed).is_on_this_computer == is_here
    assert not Endpoint.parse("/dev/tty.usbmodem1").is_radio
    assert Endpoint.parse("COM3,9600").bytes_per_s == 960
