"""The named inputs on which the equations of the baselines are tested and published."""
