"""The studio: a page on this machine on which sensors are moved, fitted and scored."""
