"""Drone-to-drone radio: messages, sealing, byte budget, map synchronisation, UDP links."""
