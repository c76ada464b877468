"""Ultrasound volumes: the type, file readers, and procedural phantoms with labels."""
