"""Change between surveys of the same ground: surfaces, their differences, and how sure these are.

Words: dz is the later height minus the earlier one; cut is volume lost, fill is volume gained, both positive; net is
fill minus cut. The level of detection is the |dz| that unchanged ground exceeds in 5% of its cells.
"""
