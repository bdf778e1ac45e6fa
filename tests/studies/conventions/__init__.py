"""How often ``svu check`` finds axes that were imported wrongly.

``written`` writes a right capture as other tools do, ``cases`` are the mistakes that it is then
imported with, ``photographs`` how it was taken, ``visible`` whether a mistake shows at all.
"""
