import numpy as np, json, sys, os
from math import *
try:
    from scipy.special import erf
except Exception:
    from numpy import vectorize
    _e=vectorize(erf)
    def erf(x): return _e(x)
def rot(axis,a):
    c,s=cos(a),sin(a)
    return {'x':np.array([[1,0,0],[0,c,-s],[0,s,c]]),'y':np.array([[c,0,s],[0,1,0],[-s,0,c]]),'z':np.array([[c,-s,0],[s,c,0],[0,0,1]])}[axis]
def euler(r,p,y): return rot('z',y)@rot('y',p)@rot('x',r)
def quat(R):
    w=sqrt(max(0,1+R[0,0]+R[1,1]+R[2,2]))/2
    if w>0.1: return [w,(R[2,1]-R[1,2])/(4*w),(R[0,2]-R[2,0])/(4*w),(R[1,0]-R[0,1])/(4*w)]
    x=sqrt(max(0,1+R[0,0]-R[1,1]-R[2,2]))/2
    if x>0.1: return [(R[2,1]-R[1,2])/(4*x),x,(R[0,1]+R[1,0])/(4*x),(R[0,2]+R[2,0])/(4*x)]
    y=sqrt(max(0,1-R[0,0]+R[1,1]-R[2,2]))/2
    if y>0.1: return [(R[0,2]-R[2,0])/(4*y),(R[0,1]+R[1,0])/(4*y),y,(R[1,2]+R[2,1])/(4*y)]
    z=sqrt(max(0,1-R[0,0]-R[1,1]+R[2,2]))/2
    return [(R[1,0]-R[0,1])/(4*z),(R[0,2]+R[2,0])/(4*z),(R[1,2]+R[2,1])/(4*z),z]
N=64;W=.03;Z=.036;SIG=1e-3;NOISE=1e-6
edges=np.linspace(-W/2,W/2,N+1)
def gen(name,seed=1,frames=400,rate=10,users=6,sway=3,period=8,yaw=0,drift=0,climb=0,mount=(0,0,0),att=0,head=0,gnss=0,late=0,
        white=0.0005,claim=0.3,eaves=None,drop=None,drag=None,asig=None,psig=None,energy=7e-3,out='./flights'):
    g=np.random.default_rng(seed)
    t0=__import__('datetime').datetime(2026,11,23,8,0,0)
    stamp=lambda t:(t0+__import__('datetime').timedelta(seconds=float(t))).isoformat(timespec='microseconds')+'Z'
    ph=g.uniform(0,2*pi,2); y0=g.uniform(0,2*pi); dd=g.uniform(0,2*pi)
    M=euler(*[radians(a) for a in mount])
    bias=g.normal(0,1,3)*np.array([att,att,head]); gb=g.normal(0,gnss,3)
    def pose(t):
        r=radians(sway)*sin(2*pi*t/period+ph[0]);p=radians(sway)*sin(2*pi*t/(period*1.13)+ph[1]);y=y0+radians(yaw/60)*t
        pos=np.array([drift*cos(dd)*(t-30),drift*sin(dd)*(t-30),300+climb*t])
        return euler(r,p,y),pos
    # users spread within the central area
    S=np.array([[0,1,0],[1,0,0],[0,0,-1.]])
    rad=70 if drift==0 else 55
    pts=[]
    while len(pts)<users:
        c=g.uniform(-rad,rad,2)
        if all(np.hypot(*(c-q))>25 for q in pts): pts.append(c)
    pts=np.array(pts); vel=g.normal(0,.7,(users,2)); 
    T=frames/rate
    pts=pts-vel*T/2*0.5 if T<200 else pts
    turn=g.uniform(20,60,users)
    def where(u,t):
        # walks to and fro
        ph=2*pi*t/turn[u]
        return pts[u]+vel[u]*turn[u]/(2*pi)*np.array([sin(ph),1-cos(ph)])
    ev=g.uniform(-40,40,2)
    k=0
    while min(np.hypot(*(ev-where(u,tt))) for u in range(users) for tt in np.arange(0,T,2))<18 and k<500: ev=g.uniform(-60,60,2);k+=1
    img=np.zeros((frames,N,N),np.float32)
    invis=0
    truth=[]
    for f in range(frames):
        t=f/rate; R,pos=pose(t); row=[]
        em=[(where(u,t)) for u in range(users)]
        if eaves and eaves[0]<=t<eaves[1]: em.append(ev)
        for i,p in enumerate(em):
            d=M.T@R.T@S@(np.array([p[0],p[1],0])-pos)   # camera f,r,d
            x,y=Z*d[1]/d[2],Z*d[0]/d[2]
            if abs(x)>W/2 or abs(y)>W/2: invis+=1
            L=np.linalg.norm([p[0]-pos[0],p[1]-pos[1],pos[2]])
            e=energy*exp(g.normal(0,.09))*(300/L)**2
            gx=np.diff(.5*(1+erf((edges-x)/SIG/sqrt(2)))); gy=np.diff(.5*(1+erf((edges-y)/SIG/sqrt(2))))
            img[f]+=(e*np.outer(gy,gx)).astype(np.float32)
            row.append([float(p[0]),float(p[1])])
        truth.append(row)
        img[f]+=g.normal(0,NOISE,(N,N)).astype(np.float32)
    np.save(f'{out}/{name}.npy',img)
    with open(f'{out}/{name}.poses','w') as fo:
        for t in np.arange(-.4,T+.6,.02):
            if drop and drop[0]<=t<drop[1]: continue
            R,pos=pose(t); w=g.normal(0,white,3)
            e=bias+w; ang=np.linalg.norm(e)
            if ang>0:
                K=np.array([[0,-e[2],e[1]],[e[2],0,-e[0]],[-e[1],e[0],0]])/ang
                E=np.eye(3)+sin(ang)*K+(1-cos(ang))*K@K
            else: E=np.eye(3)
            p=pos+gb+g.normal(0,.02,3)
            if drag and t>drag[0]: p=p+np.array([drag[1]*(t-drag[0]),0,0])
            o={"time":stamp(t+late),"x_m":p[0],"y_m":p[1],"z_m":p[2],"q":quat(E@R)}
            a=max(att,white,asig or 0); 
            if asig!=-1: o["attitude_sigma_rad"]=max(att,head,.002) if asig is None else asig
            if psig!=-1: o["position_sigma_m"]=max(gnss,.05) if psig is None else psig
            fo.write(json.dumps(o)+'\n')
    with open(f'{out}/{name}.ndjson','w') as fo:
        cl=[]
        for u in range(users):
            for k in range(int(T)+1):
                t=k+ (u*.13 if k else 0)
                p=where(u,t)+g.normal(0,claim,2)
                cl.append((t,u,p))
        for t,u,p in sorted(cl,key=lambda c:c[0]):
            fo.write(json.dumps({"time":stamp(t),"user":f"u-{u}","x_m":p[0],"y_m":p[1],"sigma_m":claim,"state":"active"})+'\n')
    json.dump(truth,open(f'{out}/{name}.truth.json','w'))
    open(f'{out}/{name}.toml','w').write(f'''[optics]
altitude_m = 300.0
lens_radius_m = 0.05
plane_distance_m = 0.036
pixels = [64, 64]
sensor_size_m = [0.03, 0.03]
spot_sigma_m = 0.001
noise_std_j = 1e-06
[source]
kind = "replay"
frames = "{name}.npy"
start = "2026-11-23T08:00:00Z"
rate_hz = {float(rate)}
speed = 0
loop = false
[claims]
log = "{name}.ndjson"
[platform]
kind = "replay"
poses = "{name}.poses"
mount = {{ roll_deg = {float(mount[0])}, pitch_deg = {float(mount[1])}, yaw_deg = {float(mount[2])} }}
''')
    return invis
ERR=dict(att=.003,head=radians(1.5),gnss=1.0,late=.03)
CASES={
 'sway3':dict(sway=3,**ERR),'sway8':dict(sway=8,**ERR),'yaw60':dict(sway=3,yaw=60,**ERR),'drift2':dict(sway=3,drift=2,**ERR),
 'climb':dict(sway=3,climb=1,**ERR),'mount90':dict(sway=3,yaw=60,mount=(0,0,90),**ERR),'all':dict(sway=5,yaw=60,drift=1,climb=.5,mount=(2,-3,90),**ERR),
 'two':dict(sway=5,users=2,**ERR),'one':dict(sway=5,users=1,**ERR),'sigma1':dict(sway=5,yaw=60,claim=1.0,**ERR),
 'eaves':dict(sway=5,yaw=60,eaves=(20,35),**ERR),'eaves1':dict(sway=5,users=1,yaw=60,eaves=(20,35),**ERR),
 'drop':dict(sway=3,drop=(20,40),**ERR),'drag':dict(sway=3,drag=(20,1.0),**ERR),'dragthree':dict(sway=3,users=3,drag=(20,1.0),**ERR),
 'nosigma':dict(sway=5,yaw=60,asig=-1,psig=-1,**ERR)}
if __name__=='__main__':
    seeds=int(sys.argv[1]) if len(sys.argv)>1 else 1
    names=sys.argv[2:] or CASES
    for n in names:
        for s in range(seeds):
            print(n,s,gen(f'{n}-{s}',seed=100+s,**CASES[n]),flush=True)
