"""What kind a tissue's anatomical name says it is; knows English and Latin words, not files."""

from __future__ import annotations

import re

from musclefit.anatomy.model import TissueKind

_SKIN = "skin body epidermis"

_OTHER = """
fat adipose subcutaneous cartilage cartilages disc discs disk meniscus ligament tendon aponeurosis fascia artery
arteries aorta vein veins vena vessel vessels nerve nerves trunk cord brain lung lungs heart atrium ventricle liver
spleen kidney stomach gallbladder pancreas duodenum colon bowel bladder prostate esophagus trachea thyroid gland gyrus
cortex matter csf eye lens marrow bursa capsule
"""

_MUSCLE = """
muscle muscles musculus gluteus iliopsoas psoas iliacus autochthon biceps triceps quadriceps brachialis
brachioradialis deltoid deltoideus supraspinatus infraspinatus subscapularis trapezius latissimus pectoralis serratus
rhomboid rhomboideus flexor extensor abductor adductor pronator supinator opponens anconeus sartorius gracilis
semitendinosus semimembranosus vastus soleus gastrocnemius plantaris popliteus tibialis peroneus fibularis piriformis
obturator gemellus pectineus quadratus tensor multifidus erector rotatores longissimus iliocostalis spinalis
semispinalis splenius scalene scalenus sternocleidomastoid levator coracobrachialis palmaris lumbrical lumbricals
interosseous interossei diaphragm masseter temporalis pterygoid buccinator platysma oblique transversus intercostal
intercostals thenar hypothenar hamstrings teres
"""

_BONE = """
bone bones femur tibia fibula patella humerus radius ulna scapula clavicle clavicula sternum manubrium rib ribs costa
vertebra vertebrae sacrum coccyx hip pelvis ilium ischium pubis skull cranium mandible maxilla talus calcaneus
navicular cuboid cuneiform metatarsal metatarsals tarsal scaphoid lunate triquetral triquetrum pisiform trapezium
trapezoid capitate hamate metacarpal metacarpals carpal phalanx phalanges hyoid atlas axis sesamoid zygomatic
"""

_ABSOLUTE = {"skin": TissueKind.SKIN, "muscle": TissueKind.MUSCLE, "bone": TissueKind.BONE, "other": TissueKind.OTHER}
"""Words that decide where a name starts with them, as names of files do."""

_IN_TURN = (
    (TissueKind.OTHER, frozenset(_OTHER.split())),
    (TissueKind.MUSCLE, frozenset(_MUSCLE.split())),
    (TissueKind.BONE, frozenset(_BONE.split())),
    (TissueKind.SKIN, frozenset(_SKIN.split())),
)
"""Costal cartilage is not bone, intermuscular fat not muscle, tibialis anterior not a tibia, the body of a vertebra not
skin: the first kind that has one of the name's words counts. A word of the body alone, such as TotalSegmentator's, is
its skin."""


def kind_by_name(name: str) -> TissueKind | None:
    """The kind that a name says, such as femur_left or gluteus_maximus; None where it says none."""
    words = [word for word in re.split(r"[^a-z]+", name.lower()) if word]
    if words and words[0] in _ABSOLUTE:
        return _ABSOLUTE[words[0]]
    for kind, known in _IN_TURN:
        if known.intersection(words):
            return kind
    return None
