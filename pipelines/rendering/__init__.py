"""Training examples rendered with Mitsuba 3: random scenes, path samples with features, independent references.

Importing this package needs no Mitsuba; job.render_scenes is the way in.
"""
