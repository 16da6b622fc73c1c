"""Telemetry links: MAVLink over a serial port, UDP or TCP.

::

    Endpoint.parse("/dev/ttyUSB0,57600")        what a pilot types, and what it means
    open_transport(endpoint)                    bytes, or what to do when they cannot flow
    with Link(endpoint) as link:                a thread that listens, asks, and comes back
        flight = link.flight()                  the last minutes as a flight
    Vehicle(flight, transport).run()            a flight played out as an autopilot would send it
"""

from glstar.link.endpoint import Endpoint
from glstar.link.framing import Framer, Packet
from glstar.link.messages import carried_rate_hz
from glstar.link.recorder import Recorder
from glstar.link.supervisor import Link, LinkEvent, LinkStatus, NewestAttitude
from glstar.link.transport import Transport, open_transport, serial_ports
from glstar.link.vehicle import PlayedFlight, Vehicle

__all__ = [
    "Endpoint",
    "Framer",
    "Link",
    "LinkEvent",
    "LinkStatus",
    "NewestAttitude",
    "Packet",
    "PlayedFlight",
    "Recorder",
    "Transport",
    "Vehicle",
    "carried_rate_hz",
    "open_transport",
    "serial_ports",
]
