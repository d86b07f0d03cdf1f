"""Tables and curves of methods: compare, sweep, ablate, composition."""
