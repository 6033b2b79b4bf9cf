"""`lbmc bench`: speed against error, every method on every scene of a folder, as JSON, a table and one HTML page.

job.py is the function, options.py what it is told, protocol.py what runs in which order. scenes.py finds and thins
scenes, methods.py runs one method, clock.py times its stages, timing.py lets methods take turns, memory.py measures
their memory, savings.py what a frame can do without, growth.py the cost against samples per pixel; attempts.py keeps
what fails apart. results.py is what comes of it, tables.py, charts.py and report.py say it to a reader.
"""
