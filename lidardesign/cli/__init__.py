"""The command line: one thin file per subcommand; options and their help are in `lidardesign.choices`."""
