"""What a design sees: first hits, gates and outcomes of every ray."""
