"""IMAGINE: small drones that explore unknown indoor spaces together."""

__version__ = "0.1.0"
