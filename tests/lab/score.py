import json,sys
import numpy as np
from itertools import permutations
out,truth=sys.argv[1:3]
t=json.load(open(truth))
fr=t['frames'] if isinstance(t,dict) and 'frames' in t else t
inv=miss=0; r=[];in95=0;n=0
for l in open(out):
    o=json.loads(l); k=o['frame']
    f=fr[k]
    pass
    P=np.array(f['xy_m']); b=f['crb_m2']
    Q=np.array([[e['x_m'],e['y_m']] for e in o['emitters']]).reshape(-1,2)
    used=set()
    for i,p in enumerate(P):
        if len(Q)==0: miss+=1; continue
        d=np.hypot(*(Q-p).T); j=int(d.argmin())
        if d[j]>5 or j in used: miss+=1; continue
        used.add(j); n+=1
        if b[i]: r.append(d[j]**2/b[i])
        c=np.array(o['emitters'][j]['cov_m2']); v=Q[j]-p
        in95+= v@np.linalg.solve(c,v)<5.99
    inv+=len(Q)-len(used)
r=np.array(r); print(out,'matched',n,'missed',miss,'invented',inv,'mean ratio',r.mean() if len(r) else None,'median',np.median(r) if len(r) else None,'in95',in95/max(n,1))
