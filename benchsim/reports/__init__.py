"""Pictures of finished results; nothing is computed here."""
