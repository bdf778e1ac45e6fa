"""Do cameras, object, light and photographs fit each other? And if not, what would make them?"""

from svu_mi.checking.apply import apply_fixes as apply_fixes
from svu_mi.checking.record import Check as Check
from svu_mi.checking.run import check as check
