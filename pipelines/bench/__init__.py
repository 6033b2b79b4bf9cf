"""`lbmc bench`: speed against error, every method on every scene of a folder, as JSON, a table and one HTML page.

scenes.py finds and thins scenes, methods.py runs one method, clock.py times its stages, job.py is the protocol,
growth.py the cost against samples per pixel, tables.py, charts.py and report.py say it to a reader.
"""
