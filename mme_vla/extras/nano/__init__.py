"""nanoMME: small policies that show on a laptop what memory is good for, from demonstrations to a
page of results.
"""
