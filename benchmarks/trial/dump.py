import sys, pickle, os
os.environ.setdefault("OMP_NUM_THREADS","1")
import numpy as np, cv2
cv2.setNumThreads(1)
from pathlib import Path
from concurrent.futures import ProcessPoolExecutor
from hbr.descriptors.registry import Joined, register, descriptor
from hbr.descriptors.together import ViewsTogether
from hbr.drawing.bench import ENROLLMENT, HARD, MILD, Visit
from hbr.evaluation import changes as C
from hbr.evaluation.photographs import load_coil, read_photograph
from hbr.evaluation.protocol import generator
from hbr.segmentation import Background
from hbr.core.angles import wrap180
parts = [descriptor(n) for n in ("edges","colours","network","cedd")]
ALL = Joined("all",1,tuple(parts),(0.3,0.2,0.3,0.2))
try: register(ALL)
except Exception: pass
COND = sys.argv[1]
kind, *opt = COND.split(",")   # coil,hard,pic,36  | photos,clean,8 | photos,noise,8 | coilp,clean,8
DATA = {"coil":"../shared/data/coil-100","photos":"../shared/data/eth-80","coilp":"../shared/data/coil-100"}[kind]
DS = load_coil(Path(DATA))
def coil(j):
    change, pic, count = opt[0], opt[1]=="pic", int(opt[2])
    item = DS.objects[j]
    visit = C._enrollment_visit()
    en=None
    places = C.nearest_photographs(item, np.arange(count)*360/count)
    v=ViewsTogether(ALL,several=False); empty=Background(visit.empty()) if pic else None
    for p in places:
        v.learn(visit.photograph(*C.cut_out(item,p), item.photographs[p].azimuth_deg).image, empty)
    v.revise()
    en=(np.stack([l[0] for l in v.levels]), item.azimuth_deg[places])
    before=C._bench_image(None if pic else DS.objects[0])
    S=[]
    for trial in range(4):
        rng=generator(0,item.name,"trial",trial)
        bench=C._benches()[int(rng.integers(12))] if change=="hard" else C._enrollment_bench()
        visit=Visit(bench, HARD if change=="hard" else MILD, rng)
        first=rng.uniform(0,360)
        vv=ViewsTogether(ALL); empty=Background(visit.empty()) if pic else None
        same=None; steps=[]
        for place in C.nearest_photographs(item, first+90.*np.arange(4)):
            az=item.photographs[place].azimuth_deg
            frame=visit.photograph(*C.cut_out(item,place),az).image
            if same is None: same=before.shows_same_bench(frame)
            vv.add(frame,empty)
            steps.append(dict(levels=[l.copy() for l in vv.levels], az=az, methods=[[str(x.method) for x in s] for s in vv.segmentations], reliable=vv.reliable))
        S.append(dict(same=same,steps=steps))
    return item.name,en,S
def photos(j):
    noise, count = opt[0], int(opt[1])
    item=DS.objects[j]; n=len(item.photographs)
    places=C.nearest_photographs(item, np.arange(count)*360/count)
    v=ViewsTogether(ALL,several=False)
    for p in places: v.learn(read_photograph(item.photographs[p].path))
    v.revise()
    en=(np.stack([l[0] for l in v.levels]), item.azimuth_deg[places])
    others=[i for i in range(n) if i not in places]
    S=[]
    for trial in range(8 if kind=="photos" else 4):
        rng=generator(0,item.name,"trial",trial)
        start=others[trial] if kind=="photos" else others[int(rng.integers(len(others)))]
        vv=ViewsTogether(ALL); steps=[]
        azs=item.azimuth_deg
        for k in range(4):
            t=azs[start]+90*k
            i=others[int(np.abs(wrap180(azs[others]-t)).argmin())]
            img=read_photograph(item.photographs[i].path)
            if noise=="noise":
                img=np.clip(img+rng.normal(0,np.sqrt(0.012)*255,img.shape),0,255).astype(np.uint8)
            vv.add(img)
            steps.append(dict(levels=[l.copy() for l in vv.levels], az=float(azs[i]), methods=[[str(x.method) for x in s] for s in vv.segmentations], reliable=vv.reliable))
        S.append(dict(same=None,steps=steps))
    return item.name,en,S
if __name__=="__main__":
    f = coil if kind=="coil" else photos
    out=[]
    with ProcessPoolExecutor(2) as ex:
        for r in ex.map(f, range(len(DS.objects))): out.append(r)
    pickle.dump(out, open(f"trial/{COND}.pkl","wb"))
