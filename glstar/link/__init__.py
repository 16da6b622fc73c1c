"""Telemetry links: MAVLink over a serial port, UDP or TCP.

::

    Endpoint.parse("/dev/ttyUSB0,57600")        what a pilot types, and what it means
    open_transport(endpoint)                    bytes, or what to do when they cannot flow
    Vehicle(flight, transport).run()            a flight played out as an autopilot would send it
"""

from glstar.link.endpoint import Endpoint
from glstar.link.framing import Framer, Packet
from glstar.link.messages import carried_rate_hz
from glstar.link.transport import Transport, open_transport, serial_ports
from glstar.link.vehicle import PlayedFlight, Vehicle

__all__ = [
    "Endpoint",
    "Framer",
    "Packet",
    "PlayedFlight",
    "Transport",
    "Vehicle",
    "carried_rate_hz",
    "open_transport",
    "serial_ports",
]
