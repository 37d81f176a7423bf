"""What commands print for people: tables of designs, scores, parts and times."""
