"""Studies: many training runs that differ in chosen settings, as trials of Ray Tune, on one machine or a cluster."""
