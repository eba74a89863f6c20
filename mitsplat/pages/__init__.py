"""Self-contained HTML pages and SVG charts for reports.

Input: text, pictures and numbers. Output: one HTML file that needs no network.
"""
