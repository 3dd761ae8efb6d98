"""Wiring of the stages: tracks to a reconstruction, a video to tracks. No mathematics lives here."""
