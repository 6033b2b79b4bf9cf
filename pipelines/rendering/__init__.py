"""Training scenes: random scenes, rendered with Mitsuba into deep sample files with references."""
