"""Telemetry links: MAVLink over a serial port, UDP or TCP.

::

    endpoint = Endpoint.parse("/dev/ttyUSB0,57600")     a connection string
    with Link(endpoint) as link:                        a thread that receives, requests messages and reconnects
        flight = link.flight()                          the last minutes as a flight

    with open_transport(endpoint) as transport:         bytes over any kind of link
        Vehicle(flight, transport).run()                sends a flight as an autopilot would

====================  ==================================================================================================
module                holds
====================  ==================================================================================================
``endpoint``          connection strings
``transport``         bytes over a serial port, UDP and TCP
``framing``           packets in a stream of bytes
``supervisor``        `Link`, the thread that owns a link; ``status``: its status and events
``receiver``          attitude, position and time of one autopilot, from packets
``clock``             UTC from the time since boot
``received``          `Received`, a copy of them all, and the flight that it makes
``history``           the samples of the last minutes
``requests``          heartbeats and message-rate requests, all that glstar sends of its own accord
``injection``         position fixes, sent only if the caller gives an `Injector`
``linkgimbal``        the attitude of the gimbal that carries the camera
``simulatorstate``    the truth that a simulator sends beside the estimates
``quality``           damage, losses and floods
``recorder``          recording to a ``.tlog``
``vehicle``           `Vehicle`, the sender of ``glstar replay-link``
====================  ==================================================================================================
"""

from glstar.link.endpoint import Endpoint
from glstar.link.framing import Framer, Packet
from glstar.link.history import Estimate
from glstar.link.injection import InjectedMessage, Injector, PositionFix
from glstar.link.messages import carried_rate_hz
from glstar.link.recorder import LinkRecording, Recorder
from glstar.link.status import LatestAttitude, LinkEvent, LinkStatus
from glstar.link.supervisor import Link, Truth
from glstar.link.transport import Transport, open_transport, serial_ports
from glstar.link.vehicle import PlayedFlight, Vehicle

__all__ = [
    "Endpoint",
    "Estimate",
    "Framer",
    "InjectedMessage",
    "Injector",
    "LatestAttitude",
    "Link",
    "LinkEvent",
    "LinkRecording",
    "LinkStatus",
    "Packet",
    "PlayedFlight",
    "PositionFix",
    "Recorder",
    "Transport",
    "Truth",
    "Vehicle",
    "carried_rate_hz",
    "open_transport",
    "serial_ports",
]
