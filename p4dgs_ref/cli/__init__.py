"""The command line: the parser, one thin function a command, and what they print."""
