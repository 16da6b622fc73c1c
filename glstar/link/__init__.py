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
``packets``           message numbers, packets in a stream of bytes, recording to a ``.tlog``
``history``           the samples of the last minutes, and the truth that a simulator sends beside the estimates
``status``            status, events, damage, losses and floods
``clock``             UTC from the time since boot
``gimbal``            the attitude of the gimbal that carries the camera
``receiver``          attitude, position and time of one autopilot, from packets
``outgoing``          all that glstar sends: heartbeats, requests, and position fixes if the caller gives an `Injector`
``camera``            a MAVLink camera beside the vehicle, if the caller gives a `CameraComponent`
``supervisor``        `Link`, the thread that owns a link; `Received`, the copy from which it makes a flight
``vehicle``           `Vehicle`, the sender of ``glstar live replay``
====================  ==================================================================================================
"""

from glstar.link.camera import CAMERA_ID, CameraComponent, CameraFacts, CapturedImage
from glstar.link.endpoint import Endpoint
from glstar.link.history import Estimate
from glstar.link.outgoing import InjectedMessage, Injector, PositionFix
from glstar.link.packets import Framer, Packet, Recorder, carried_rate_hz
from glstar.link.status import LatestAttitude, LinkEvent, LinkStatus
from glstar.link.supervisor import Clock, Link, Truth
from glstar.link.transport import Transport, open_transport, serial_ports
from glstar.link.vehicle import Vehicle

__all__ = [
    "CAMERA_ID",
    "CameraComponent",
    "CameraFacts",
    "CapturedImage",
    "Clock",
    "Endpoint",
    "Estimate",
    "Framer",
    "InjectedMessage",
    "Injector",
    "LatestAttitude",
    "Link",
    "LinkEvent",
    "LinkStatus",
    "Packet",
    "PositionFix",
    "Recorder",
    "Transport",
    "Truth",
    "Vehicle",
    "carried_rate_hz",
    "open_transport",
    "serial_ports",
]
