"""Self-contained HTML pages and SVG charts for reports.

In: text, pictures and numbers. Out: one HTML file that needs no network.
"""
