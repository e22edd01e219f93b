"""Plants of heliostats: site, receivers and a field, read from files; where their light is lost and where it goes."""
