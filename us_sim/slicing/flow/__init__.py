"""Blood in the vessels of deformed tissue, and how Doppler ultrasound shows it."""
