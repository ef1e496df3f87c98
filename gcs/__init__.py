"""Ground station: the state of the fleet, a web page and a terminal table to see it, and the pilot's commands."""
