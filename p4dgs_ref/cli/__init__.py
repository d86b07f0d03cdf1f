"""The command line: one table of commands and options, one thin function a command."""
