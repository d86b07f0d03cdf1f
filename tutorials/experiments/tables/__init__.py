"""Tables and curves of methods: compare, curve, ablate, composition."""
