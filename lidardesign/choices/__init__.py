"""Every option of every command, written once: the command line, the Python interface and help read it here."""
